#include "bindings.h"
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
}

}  // namespace etsplat
