#include <nanobind/ndarray.h>

#include "bindings.h"
#include "bvh.h"
#include "crossings.h"
#include "flips.h"
#include "intersections.h"
#include "parallel.h"
#include "subdivision.h"

namespace etsplat {

void bind_geometry(nb::module_& m) {
    // order, longest_edge and split_edge (F,); the faces around each edge.
    def_function(
        m, "select_edge_splits",
        [](Array<const int64_t, 1> order, Array<const int64_t, 1> longest_edge,
           Array<const int64_t, 1> edge_face_offsets, Array<const int64_t, 1> edge_faces, Array<int64_t, 1> split_edge,
           int64_t max_new_faces) {
            select_edge_splits(order.data(), longest_edge.data(), edge_face_offsets.data(), edge_faces.data(),
                               split_edge.data(), order.count(), max_new_faces);
        },
        "order", "longest_edge", "edge_face_offsets", "edge_faces", "split_edge", "max_new_faces");
    // vertices (V, 3); edges and edge_faces (E, 2), face_edges and faces (F, 3), valences (V,), which are kept up.
    def_function(
        m, "flip_edges",
        [](Array<const double, 2> vertices, Array<int64_t, 2> edges, Array<int64_t, 2> edge_faces,
           Array<int64_t, 2> face_edges, Array<int64_t, 2> faces, Array<int64_t, 1> valences, double least_cosine,
           int rounds) {
            const EdgesOfMesh mesh{edges.data(), edge_faces.data(), face_edges.data(), faces.data(), valences.data()};
            return flip_edges(vertices.data(), mesh, edges.size(0), least_cosine, rounds);
        },
        "vertices", "edges", "edge_faces", "face_edges", "faces", "valences", "least_cosine", "rounds");
    // vertices (V, 3), faces (F, 3) with F > 0.
    nb::class_<Bvh>(m, "FaceTree");
    def_function(
        m, "face_tree",
        [](Array<const double, 2> vertices, Array<const int64_t, 2> faces) {
            return Bvh(vertices.data(), faces.data(), faces.size(0));
        },
        "vertices", "faces");
    def_function(
        m, "move_face_tree",
        [](Bvh& tree, Array<const double, 2> vertices, Array<const int64_t, 2> faces) {
            tree.move(vertices.data(), faces.data());
        },
        "tree", "vertices", "faces");
    // points (N, 3); squared_distances and closest (N,).
    def_function(
        m, "closest_faces",
        [](const Bvh& tree, Array<const double, 2> points, Array<double, 1> squared_distances, Array<int64_t, 1> closest) {
            parallel_for(points.size(0), 256, [&](int64_t begin, int64_t end) {
                for (int64_t i = begin; i < end; ++i) {
                    const Bvh::Nearest nearest = tree.nearest(vertex(points.data(), i));
                    squared_distances.data()[i] = nearest.squared_distance;
                    closest.data()[i] = nearest.face;
                }
            });
        },
        "tree", "points", "squared_distances", "closest");
    // again and intersecting (F,).
    def_function(
        m, "mark_intersecting_faces",
        [](const Bvh& tree, OptionalArray<const bool, 1> again, Array<bool, 1> intersecting) {
            mark_intersecting_faces(tree, reinterpret_cast<const uint8_t*>(data_or_null(again)),
                                    reinterpret_cast<uint8_t*>(intersecting.data()));
        },
        "tree", "again", "intersecting");
    // (N, 2) pairs of faces.
    m.def(
        "overlapping_boxes",
        [](const Bvh& tree) {
            std::vector<int64_t>* pairs;
            {
                nb::gil_scoped_release release;
                pairs = new std::vector<int64_t>(overlapping_boxes(tree));
            }
            nb::capsule owner(pairs, [](void* p) noexcept { delete static_cast<std::vector<int64_t>*>(p); });
            return nb::ndarray<nb::numpy, int64_t, nb::ndim<2>>(pairs->data(), {pairs->size() / 2, 2}, owner);
        },
        nb::kw_only(), nb::arg("tree"),
        nb::sig("def overlapping_boxes(*, tree: FaceTree) -> numpy.typing.NDArray[numpy.int64]"));
    // points (P, 3), own (P, K); counts (P,).
    def_function(
        m, "count_crossings",
        [](Array<const double, 2> points, Array<const int64_t, 2> own, Array<const double, 2> vertices,
           Array<const int64_t, 2> faces, Array<int64_t, 1> counts) {
            count_crossings(points.data(), own.data(), points.size(0), own.size(1), vertices.data(), faces.data(),
                            faces.size(0), counts.data());
        },
        "points", "own", "vertices", "faces", "counts");
}

}  // namespace etsplat
