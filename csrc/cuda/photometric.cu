// The L1 loss over a background. The value reads 28 bytes of every pixel; the gradient reads them again and writes 12,
// rather than keep a gradient that backward would have to scale. Bytes bound both. A block takes kPixels pixels and
// leaves their sum in double; a second, single block adds the sums up in a fixed order.
#include "cuda/block_sum.h"
#include "math/photometric.h"

using namespace etsplat;

constexpr int kThreads = 256;
constexpr int kPixels = 4 * kThreads;  // of a block

// Pixel k of this block, among all views; -1 beyond the end of the view. Grid: (blocks of a view, views).
__device__ long long pixel_at(int k, long long pixels) {
    const long long p = blockIdx.x * static_cast<long long>(kPixels) + k;
    return p < pixels ? blockIdx.y * pixels + p : -1;
}

__device__ float l1_difference(const float* color, const float* target, const float* background, long long at, int c) {
    const float rest = 1.0f - target[4 * at + 3];
    return color[3 * at + c] - over_background(target[4 * at + c], rest, background[c]);
}

// color (B, P, 3), target (B, P, 4), backgrounds (B, 3).
extern "C" __global__ void l1_sums(const float* color, const float* target, const float* backgrounds, long long pixels,
                                   double* sums) {
    __shared__ double scratch[kThreads / kWarp];
    const float* background = backgrounds + 3 * blockIdx.y;
    double sum = 0.0;
    for (int k = threadIdx.x; k < kPixels; k += kThreads) {
        const long long at = pixel_at(k, pixels);
        for (int c = 0; c < 3 && at >= 0; ++c) sum += vabs(l1_difference(color, target, background, at, c));
    }
    sum = block_sum<kThreads>(sum, scratch);
    if (threadIdx.x == 0) sums[blockIdx.y * static_cast<long long>(gridDim.x) + blockIdx.x] = sum;
}

// One block: the mean of `values` values from `count` sums.
extern "C" __global__ void l1_mean(const double* sums, long long count, long long values, float* mean) {
    __shared__ double scratch[kThreads / kWarp];
    const double sum = sum_of_array<kThreads>(sums, count, 1, scratch);
    if (threadIdx.x == 0) *mean = static_cast<float>(sum / static_cast<double>(values));
}

// gradient (B, P, 3) = grad_loss times that of the mean.
extern "C" __global__ void l1_backward(const float* color, const float* target, const float* backgrounds,
                                       long long pixels, const float* grad_loss, float* gradient) {
    const double values = 3.0 * static_cast<double>(gridDim.y) * static_cast<double>(pixels);
    const float scale = *grad_loss * static_cast<float>(1.0 / values);
    const float* background = backgrounds + 3 * blockIdx.y;
    for (int k = threadIdx.x; k < kPixels; k += kThreads) {
        const long long at = pixel_at(k, pixels);
        for (int c = 0; c < 3 && at >= 0; ++c) {
            gradient[3 * at + c] = l1_gradient(l1_difference(color, target, background, at, c), scale);
        }
    }
}
