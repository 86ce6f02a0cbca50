// L1 (or squared) difference and SSIM of images, with the gradient, in two launches over tiles of kTile x kTile pixels, one
// channel after the other. photometric_sums loads a tile with its surroundings into shared memory, blurs four moments
// along x, then along y, sums both terms and keeps the three derivative maps (csrc/math/ssim.h). photometric_backward
// blurs the maps in the same way. Sums are in double, of a tile, added up by one block in a fixed order.
//
// Each value takes 7 blurs of 11 taps along both axes, with the surroundings 202 multiply-adds, and as many loads from
// shared memory, which bound it: 83 microseconds for a megapixel at one load per clock and multiprocessor of an H100. Bytes:
// a pixel is read with 2.6 times its neighbours (from the L2 cache), its maps are 36 bytes written and read again.
// Without SSIM (dssim_weight 0) each pixel is read once forward and once backward, and bytes bound both.
#include "cuda/block_sum.h"
#include "math/photometric.h"
#include "math/ssim.h"

using namespace etsplat;

constexpr int kTile = 16;
constexpr int kThreads = kTile * kTile;
constexpr int kAround = kTile + 2 * kSsimReach;

struct Photometric {
    const float* color;        // (B, H, W, 3)
    const void* target;        // (B, H, W, channels), bytes or floats; four channels are premultiplied RGBA
    const float* backgrounds;  // (B, 3) behind a transparent target; null is black
    const float* mask;         // (B, H, W), or null: 1 everywhere
    int views, height, width, channels;
    int bytes, squared;
    float dssim_weight;
};

__device__ float target_value(const Photometric& p, long long index) {
    return p.bytes ? unit_value(static_cast<const unsigned char*>(p.target)[index])
                   : unit_value(static_cast<const float*>(p.target)[index]);
}

// What is compared at a channel of a pixel: x = y + mask (color - y) and y, the target over its background.
struct Compared {
    float x, y;
};

__device__ Compared compared_at(const Photometric& p, int view, int row, int column, int c) {
    if (row < 0 || row >= p.height || column < 0 || column >= p.width) return {0.0f, 0.0f};
    const long long at = (static_cast<long long>(view) * p.height + row) * p.width + column;
    float y = target_value(p, p.channels * at + c);
    if (p.channels == 4) {
        const float rest = 1.0f - target_value(p, 4 * at + 3);
        y = over_background(y, rest, p.backgrounds ? p.backgrounds[3 * view + c] : 0.0f);
    }
    const float color = p.color[3 * at + c];
    return {p.mask ? y + p.mask[at] * (color - y) : color, y};
}

__device__ long long map_at(const Photometric& p, int view, int c, int map, int row, int column) {
    return (((static_cast<long long>(view) * 3 + c) * 3 + map) * p.height + row) * p.width + column;
}

// One channel of a tile and its surroundings.
struct Surroundings {
    float xs[kAround][kAround], ys[kAround][kAround], blurred[4][kAround][kTile];
};

// Means of x, y, x^2 + y^2 and x y under the window at this thread's pixel. Every thread of the block calls it.
__device__ void window_moments(const Photometric& p, int c, Surroundings& near, float moments[4]) {
    const int left = blockIdx.x * kTile - kSsimReach, top = blockIdx.y * kTile - kSsimReach;
    __syncthreads();  // the channel before is done
    for (int k = threadIdx.x; k < kAround * kAround; k += kThreads) {
        const int row = k / kAround, column = k % kAround;
        const Compared v = compared_at(p, blockIdx.z, top + row, left + column, c);
        near.xs[row][column] = v.x;
        near.ys[row][column] = v.y;
    }
    __syncthreads();
    for (int k = threadIdx.x; k < kAround * kTile; k += kThreads) {
        const int row = k / kTile, column = k % kTile;
        const float *x = near.xs[row] + column + kSsimReach, *y = near.ys[row] + column + kSsimReach;
        near.blurred[0][row][column] = ssim_blur([=](int d) { return x[d]; });
        near.blurred[1][row][column] = ssim_blur([=](int d) { return y[d]; });
        near.blurred[2][row][column] = ssim_blur([=](int d) { return x[d] * x[d] + y[d] * y[d]; });
        near.blurred[3][row][column] = ssim_blur([=](int d) { return x[d] * y[d]; });
    }
    __syncthreads();
    const int i = threadIdx.x / kTile + kSsimReach, j = threadIdx.x % kTile;
    for (int m = 0; m < 4; ++m) moments[m] = ssim_blur([&](int d) { return near.blurred[m][i + d][j]; });
}

// maps (B, 3 channels, 3, H, W), or null; sums: 2 per block, of the pixel term and of the similarities.
extern "C" __global__ void photometric_sums(Photometric p, float* maps, double* sums) {
    __shared__ Surroundings near;
    __shared__ double scratch[kThreads / kWarp];
    const int view = blockIdx.z;
    const int row = blockIdx.y * kTile + threadIdx.x / kTile, column = blockIdx.x * kTile + threadIdx.x % kTile;
    const bool structural = p.dssim_weight > 0.0f;
    double pixel_sum = 0.0, similarity_sum = 0.0;
    for (int c = 0; c < 3; ++c) {
        float moments[4];
        if (structural) window_moments(p, c, near, moments);
        if (row >= p.height || column >= p.width) continue;
        const Compared v = compared_at(p, view, row, column, c);
        pixel_sum += p.squared ? (v.x - v.y) * (v.x - v.y) : vabs(v.x - v.y);
        if (!structural) continue;
        const Similarity s = similarity(moments[0], moments[1], moments[2], moments[3]);
        similarity_sum += s.value;
        if (!maps) continue;
        const float derivatives[3] = {s.by_mean, s.by_square, s.by_product};
        for (int m = 0; m < 3; ++m) maps[map_at(p, view, c, m, row, column)] = derivatives[m];
    }
    pixel_sum = block_sum<kThreads>(pixel_sum, scratch);
    similarity_sum = block_sum<kThreads>(similarity_sum, scratch);
    if (threadIdx.x == 0) {
        const long long block = (static_cast<long long>(blockIdx.z) * gridDim.y + blockIdx.y) * gridDim.x + blockIdx.x;
        sums[2 * block] = pixel_sum;
        sums[2 * block + 1] = similarity_sum;
    }
}

// One block: (1 - l) mean of the pixel term + l (1 - mean of the similarities), from `count` pairs of sums.
extern "C" __global__ void photometric_loss(Photometric p, const double* sums, long long count, float* loss) {
    __shared__ double scratch[kThreads / kWarp];
    const double pixel = sum_of_array<kThreads>(sums, count, 2, scratch);
    const double similarities = sum_of_array<kThreads>(sums + 1, count, 2, scratch);
    const double values = 3.0 * static_cast<double>(static_cast<long long>(p.views) * p.height * p.width);
    const double l = p.dssim_weight;
    if (threadIdx.x == 0) *loss = static_cast<float>((1.0 - l) * pixel / values + l * (1.0 - similarities / values));
}

// One channel of the derivative maps around a tile.
struct MapSurroundings {
    float around[3][kAround][kAround], blurred[3][kAround][kTile];
};

// The derivative maps of a channel, blurred, at this thread's pixel. Every thread of the block calls it.
__device__ void blurred_maps(const Photometric& p, const float* maps, int c, MapSurroundings& near, float slopes[3]) {
    const int left = blockIdx.x * kTile - kSsimReach, top = blockIdx.y * kTile - kSsimReach;
    __syncthreads();  // the channel before is done
    for (int k = threadIdx.x; k < 3 * kAround * kAround; k += kThreads) {
        const int map = k / (kAround * kAround), y = k / kAround % kAround, x = k % kAround;
        const int row = top + y, column = left + x;
        const bool outside = row < 0 || row >= p.height || column < 0 || column >= p.width;
        near.around[map][y][x] = outside ? 0.0f : maps[map_at(p, blockIdx.z, c, map, row, column)];
    }
    __syncthreads();
    for (int k = threadIdx.x; k < 3 * kAround * kTile; k += kThreads) {
        const int map = k / (kAround * kTile), y = k / kTile % kAround, x = k % kTile;
        const float* from = near.around[map][y] + x + kSsimReach;
        near.blurred[map][y][x] = ssim_blur([=](int d) { return from[d]; });
    }
    __syncthreads();
    const int i = threadIdx.x / kTile + kSsimReach, j = threadIdx.x % kTile;
    for (int m = 0; m < 3; ++m) slopes[m] = ssim_blur([&](int d) { return near.blurred[m][i + d][j]; });
}

// gradient (B, H, W, 3) = grad_loss times that of the loss. `maps` is not read where the loss has no SSIM.
extern "C" __global__ void photometric_backward(Photometric p, const float* maps, const float* grad_loss,
                                                float* gradient) {
    __shared__ MapSurroundings near;
    const int view = blockIdx.z;
    const int row = blockIdx.y * kTile + threadIdx.x / kTile, column = blockIdx.x * kTile + threadIdx.x % kTile;
    const bool structural = p.dssim_weight > 0.0f;
    const double values = 3.0 * static_cast<double>(static_cast<long long>(p.views) * p.height * p.width);
    const float pixel_weight = static_cast<float>((1.0 - static_cast<double>(p.dssim_weight)) / values);
    const float ssim_weight = static_cast<float>(static_cast<double>(p.dssim_weight) / values);
    for (int c = 0; c < 3; ++c) {
        float slopes[3];
        if (structural) blurred_maps(p, maps, c, near, slopes);
        if (row >= p.height || column >= p.width) continue;
        const Compared v = compared_at(p, view, row, column, c);
        float g = p.squared ? 2.0f * pixel_weight * (v.x - v.y) : l1_gradient(v.x - v.y, pixel_weight);
        if (structural) g -= ssim_weight * similarity_slope(slopes[0], slopes[1], slopes[2], v.x, v.y);
        const long long at = (static_cast<long long>(view) * p.height + row) * p.width + column;
        gradient[3 * at + c] = *grad_loss * (p.mask ? g * p.mask[at] : g);
    }
}
