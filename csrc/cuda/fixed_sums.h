// Sums of many values into few places, the same bits in whatever order they come: integer atomics on fixed-point numbers
// whose unit is 2^-38 of the largest value. Two passes over the values: the first finds the largest, the second adds.
#pragma once

#include "cuda/common.h"

namespace etsplat {

using FixedSum = unsigned long long;  // a signed number, as atomicAdd wants it

// Records the largest magnitude of a warp's values; all its lanes call it.
__device__ __forceinline__ void record_largest(float magnitude, unsigned* largest) {
    unsigned bits = __float_as_uint(magnitude);  // of floats >= 0 the order is that of their bits; NaN is above all
    for (int distance = kWarp / 2; distance > 0; distance /= 2) {
        const unsigned other = __shfl_xor_sync(kAllLanes, bits, distance);
        bits = other > bits ? other : bits;
    }
    if (lane_index() == 0 && bits > load_relaxed(largest)) atomicMax(largest, bits);
}

// 2^38 over the power of two above the largest value; fewer than 2^25 such values fit into a sum (engines/cuda/capacity.py checks it).
__device__ __forceinline__ double fixed_scale(unsigned largest) {
    return ldexp(1.0, 38 - (static_cast<int>(largest >> 23 & 255u) - 126));
}

__device__ __forceinline__ void add_fixed(FixedSum* sum, double value, double scale) {
    const double scaled = value * scale;
    if (scaled == 0.0) return;
    atomicAdd(sum, static_cast<FixedSum>(static_cast<long long>(scaled + (scaled < 0.0 ? -0.5 : 0.5))));
}

// NaN where a value was not finite.
__device__ __forceinline__ float from_fixed(FixedSum sum, unsigned largest) {
    if (largest >= 0x7f800000u) return __uint_as_float(0x7fc00000u);
    return static_cast<float>(static_cast<double>(static_cast<long long>(sum)) / fixed_scale(largest));
}

}  // namespace etsplat
