#include "bindings.h"
#include "bvh.h"
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
    // points (N, 3), vertices (V, 3), faces (F, 3) with F > 0; squared_distances and closest (N,).
    def_function(
        m, "closest_faces",
        [](Array<const double, 2> points, Array<const double, 2> vertices, Array<const int64_t, 2> faces,
           Array<double, 1> squared_distances, Array<int64_t, 1> closest) {
            const Bvh bvh(vertices.data(), faces.data(), faces.size(0));
            parallel_for(points.size(0), 256, [&](int64_t begin, int64_t end) {
                for (int64_t i = begin; i < end; ++i) {
                    const Bvh::Nearest nearest = bvh.nearest(vertex(points.data(), i));
                    squared_distances.data()[i] = nearest.squared_distance;
                    closest.data()[i] = nearest.face;
                }
            });
        },
        "points", "vertices", "faces", "squared_distances", "closest");
    // vertices (V, 3), faces (F, 3), intersecting (F,).
    def_function(
        m, "mark_intersecting_faces",
        [](Array<const double, 2> vertices, Array<const int64_t, 2> faces, Array<bool, 1> intersecting) {
            mark_intersecting_faces(vertices.data(), faces.data(), faces.size(0),
                                    reinterpret_cast<uint8_t*>(intersecting.data()));
        },
        "vertices", "faces", "intersecting");
}

}  // namespace etsplat
