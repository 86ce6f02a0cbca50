// Rows of numbers of a block's points, staged in shared memory: device memory sees whole lines, and a row of an odd number of
// words keeps the banks apart.
#pragma once

#include "cuda/common.h"

namespace etsplat {

constexpr int kThreads = 64;     // of a block, one to a point
constexpr int kMostStaged = 48;  // numbers of a row: 12 KiB of a block

// The first Width numbers of rows of Stride; `shared` has room for kRoom.
template <int Width, int Stride>
struct StagedRows {
    static constexpr int kPitch = Width | 1, kRoom = kThreads * kPitch;
    static constexpr int kUnroll = kPitch == Stride ? Stride : 8;  // rows as they are: a copy without loop and indices
    float* shared;
    long long first;  // point of the block
    unsigned count;

    __device__ StagedRows(float* room, long long points)
        : shared(room), first(static_cast<long long>(blockIdx.x) * kThreads) {
        count = points - first < kThreads ? static_cast<unsigned>(points - first) : kThreads;
    }
    __device__ bool has_point() const { return threadIdx.x < count; }
    __device__ float* mine() const { return shared + threadIdx.x * kPitch; }
    __device__ void load(const float* from) const {
        if constexpr (Width > 0) {
            const float* block = from + first * Stride;
#pragma unroll(kUnroll)
            for (int j = 0; j < Width; ++j) {
                const unsigned i = j * kThreads + threadIdx.x, row = i / Width, column = i % Width;
                if (i < count * Width) shared[row * kPitch + column] = block[row * Stride + column];
            }
            __syncthreads();
        }
    }
    // The j-th of the thread's numbers, Stride in all, when the block has met; what is beyond Width is 0.
    struct Number {
        bool used;
        long long at;  // in the whole array
        float value;
    };
    __device__ Number number(int j) const {
        const unsigned i = j * kThreads + threadIdx.x, row = i / Stride, column = i % Stride;
        return {i < count * Stride, first * Stride + i, column < Width ? shared[row * kPitch + column] : 0.0f};
    }
    __device__ void store(float* to) const {
        if constexpr (Stride > 0) {
            __syncthreads();
#pragma unroll(kUnroll)
            for (int j = 0; j < Stride; ++j)
                if (const Number each = number(j); each.used) to[each.at] = each.value;
        }
    }
};

}  // namespace etsplat
