// What all CUDA kernels share: names of the hardware's sizes and warp-wide sums.
//
// Kernels are plain CUDA C++ that NVRTC compiles without any header, for sm_75 and up, and that the SIMT shim of the
// tests compiles with a host compiler. For its sake: shared arrays are declared in the kernel itself, kernels are
// extern "C", and no thread may leave while others of its warp still name it in a mask.
#pragma once

#include "math/portable.h"

namespace etsplat {

constexpr int kWarp = 32;
constexpr int kBlock = 256;  // threads of a block, where nothing else is said
constexpr unsigned kAllLanes = 0xffffffffu;

__device__ __forceinline__ int lane_index() { return static_cast<int>(threadIdx.x % kWarp); }
__device__ __forceinline__ int warp_index() { return static_cast<int>(threadIdx.x / kWarp); }

// A number that others may change at once by atomics: relaxed, as PTX has reads that are volatile. It may be of any time before.
template <class T>
__device__ __forceinline__ T load_relaxed(const T* address) {
    return *static_cast<const volatile T*>(address);
}

// Sum over the lanes of the warp, for all of them; the order of additions is fixed.
template <class T>
__device__ __forceinline__ T warp_sum(T value) {
    for (int distance = kWarp / 2; distance > 0; distance /= 2) value += __shfl_xor_sync(kAllLanes, value, distance);
    return value;
}

// Sum over this lane and those before it.
template <class T>
__device__ __forceinline__ T warp_inclusive_scan(T value) {
    for (int distance = 1; distance < kWarp; distance *= 2) {
        const T before = __shfl_up_sync(kAllLanes, value, distance);
        if (lane_index() >= distance) value += before;
    }
    return value;
}

}  // namespace etsplat
