// Which edges an adaptive subdivision step splits (paper, appendix "Adaptive Refinement").
#pragma once

#include <cstdint>

namespace etsplat {

// Takes the faces in `order`; each splits its longest edge and all faces around that edge, unless one of them has been
// split already. Stops before more than `max_new_faces` faces (one for each face split) would be added. Writes the
// edge at which each face is split to split_edge (num_faces values, all -1 on entry). One pass, serial: every choice
// depends on the ones before it.
void select_edge_splits(const int64_t* order, const int64_t* longest_edge, const int64_t* edge_face_offsets,
                        const int64_t* edge_faces, int64_t* split_edge, int64_t num_faces, int64_t max_new_faces);

}  // namespace etsplat
