#include "subdivision.h"

#include <algorithm>

namespace etsplat {

void select_edge_splits(const int64_t* order, const int64_t* longest_edge, const int64_t* edge_face_offsets,
                        const int64_t* edge_faces, int64_t* split_edge, int64_t num_faces, int64_t max_new_faces) {
    int64_t added = 0;
    for (int64_t i = 0; i < num_faces; ++i) {
        const int64_t edge = longest_edge[order[i]];
        const int64_t* begin = edge_faces + edge_face_offsets[edge];
        const int64_t* end = edge_faces + edge_face_offsets[edge + 1];
        if (std::any_of(begin, end, [&](int64_t face) { return split_edge[face] >= 0; })) continue;
        added += end - begin;
        if (added > max_new_faces) return;
        std::for_each(begin, end, [&](int64_t face) { split_edge[face] = edge; });
    }
}

}  // namespace etsplat
