#include "bindings.h"
#include "bvh.h"
#include "intersections.h"
#include "parallel.h"
#include "subdivision.h"

namespace etsplat {

void bind_geometry(nb::module_& m) {
    m.def(
        "select_edge_splits",
        [](Address order, Address longest_edge, Address edge_face_offsets, Address edge_faces, Address split_edge,
           int64_t num_faces, int64_t max_new_faces) {
            select_edge_splits(pointer<const int64_t>(order), pointer<const int64_t>(longest_edge),
                               pointer<const int64_t>(edge_face_offsets), pointer<const int64_t>(edge_faces),
                               pointer<int64_t>(split_edge), num_faces, max_new_faces);
        },
        NoGil());
    m.def(
        "closest_faces",
        [](Address points, int64_t num_points, Address vertices, Address faces, int64_t num_faces,
           Address squared_distances, Address closest) {
            const Bvh bvh(pointer<const double>(vertices), pointer<const int64_t>(faces), num_faces);
            parallel_for(num_points, 256, [&](int64_t begin, int64_t end) {
                for (int64_t i = begin; i < end; ++i) {
                    const Bvh::Nearest nearest = bvh.nearest(vertex(pointer<const double>(points), i));
                    pointer<double>(squared_distances)[i] = nearest.squared_distance;
                    pointer<int64_t>(closest)[i] = nearest.face;
                }
            });
        },
        NoGil());
    m.def(
        "mark_intersecting_faces",
        [](Address vertices, Address faces, int64_t num_faces, Address intersecting) {
            mark_intersecting_faces(pointer<const double>(vertices), pointer<const int64_t>(faces), num_faces,
                                    pointer<uint8_t>(intersecting));
        },
        NoGil());
}

}  // namespace etsplat
