// Checks and fills of whole arrays on the engine's own threads. Torch's pool beside ours would have twice as many threads
// as cores, and its barriers wait for every one of them: on a busy machine that cost ten times a whole render.
#pragma once

#include <cstdint>

namespace etsplat {

struct FloatScan {
    int64_t unusable;  // how many NaN, infinities, and magnitudes above `largest`
    float minimum;     // of the others; infinity if there is none
};
FloatScan scan_floats(const float* values, int64_t count, float largest);

struct IndexRange {
    int64_t low, high;
};
template <class T>
IndexRange index_range(const T* values, int64_t count);  // count > 0; T is int32_t or int64_t

// Where each of `groups` values occurs: value g at members[offsets[g]] ..., ascending; offsets (groups + 1). Values must be
// from 0 to groups - 1.
void group_indices(const int32_t* values, int64_t count, int64_t groups, int32_t* offsets, int32_t* members);

void zero_floats(float* values, int64_t count);

// sums (groups, channels): row g is the sum of the rows `members[offsets[g]] ...` of values, in that order.
void sum_groups(const float* values, const int32_t* offsets, const int32_t* members, int64_t groups, int64_t channels,
                float* sums);

}  // namespace etsplat
