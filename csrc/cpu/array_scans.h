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

template <class T>
bool indices_below(const T* values, int64_t count, int64_t bound);  // all from 0 to bound - 1; T is int32_t or int64_t

template <class T>
void copy_indices(const T* values, int64_t count, int32_t* copies);  // that fit

void zero_floats(float* values, int64_t count);
bool are_intrinsics(const float* Ks, int64_t count);  // of pinhole cameras without skew

// sums (rows, channels): row g is the sum of those rows i of values (count, channels) whose indices[i] is g, from the first
// to the last. Indices are from 0 to rows - 1.
void sum_by_index(const float* values, const int32_t* indices, int64_t count, int64_t rows, int64_t channels, float* sums);
// The same on the calling thread alone, added to what is in sums already.
void add_by_index(const float* values, const int32_t* indices, int64_t count, int64_t channels, float* sums);

// Row i of rows (count, channels) is that row of values which indices[i] says.
void gather_rows(const float* values, const int32_t* indices, int64_t count, int64_t channels, float* rows);

}  // namespace etsplat
