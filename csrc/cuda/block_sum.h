// Sums whose order of additions is fixed by the shape of the launch alone: the same bits in every run, without atomics.
#pragma once

#include "cuda/common.h"

namespace etsplat {

// Sum over the threads of a block of `Threads`; all of them call it, thread 0 gets the result. `scratch` is shared memory
// of Threads / 32 numbers.
template <int Threads>
__device__ double block_sum(double value, double* scratch) {
    value = warp_sum(value);
    __syncthreads();  // of an earlier sum
    if (lane_index() == 0) scratch[warp_index()] = value;
    __syncthreads();
    double total = 0.0;
    if (threadIdx.x == 0) {
        for (int warp = 0; warp < Threads / kWarp; ++warp) total += scratch[warp];
    }
    return total;
}

// Sum of values[0], values[stride], ... (count of them) by one block; thread 0 gets the result.
template <int Threads>
__device__ double sum_of_array(const double* values, long long count, int stride, double* scratch) {
    double sum = 0.0;
    for (long long i = threadIdx.x; i < count; i += Threads) sum += values[i * stride];
    return block_sum<Threads>(sum, scratch);
}

}  // namespace etsplat
