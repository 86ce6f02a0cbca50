// Do normals agree with those of the depth image? The value reads 20 bytes of every pixel; the gradient reads them again,
// the depths and normals around a pixel from the caches, and writes 16. It is gathered: a pixel asks its four neighbours
// what they want of its depth, so that nothing is added atomically.
#include "cuda/block_sum.h"
#include "math/depth_normals.h"

using namespace etsplat;

constexpr int kThreads = kBlock;

struct DepthNormals {
    const float *normals, *depth, *alpha, *viewmats, *Ks;  // (B, H, W, 3), (B, H, W), (B, H, W), (B, 4, 4), (B, 3, 3)
    int views, height, width;
};

__device__ long long pixel_count(const DepthNormals& p) { return static_cast<long long>(p.height) * p.width; }

// Of the pixel at row and column of a view; zeros on the border and outside.
__device__ Agreement<float> agreement_at(const DepthNormals& p, const DepthView& view, int b, int row, int column) {
    if (row < 1 || row >= p.height - 1 || column < 1 || column >= p.width - 1) return {};
    const long long at = b * pixel_count(p) + static_cast<long long>(row) * p.width + column;
    const DepthCross<float> z{p.depth[at - p.width], p.depth[at + p.width], p.depth[at - 1], p.depth[at + 1]};
    const float* n = p.normals + 3 * at;
    const float y = static_cast<float>(row), x = static_cast<float>(column);
    return agreement(view, depth_slopes(view, z, y, x), Vector3<float>{n[0], n[1], n[2]}, p.alpha[at]);
}

// Grid: (blocks of a view, views). Sums of the agreement.
extern "C" __global__ void normal_sums(DepthNormals p, double* sums) {
    __shared__ double scratch[kThreads / kWarp];
    const int b = blockIdx.y;
    const long long pixel = static_cast<long long>(blockIdx.x) * kThreads + threadIdx.x;
    double value = 0.0;
    if (pixel < pixel_count(p)) {
        const DepthView view = depth_view(p.viewmats + 16 * b, p.Ks + 9 * b);
        value = agreement_at(p, view, b, static_cast<int>(pixel / p.width), static_cast<int>(pixel % p.width)).value;
    }
    value = block_sum<kThreads>(value, scratch);
    if (threadIdx.x == 0) sums[b * static_cast<long long>(gridDim.x) + blockIdx.x] = value;
}

// One block: 1 - the mean agreement.
extern "C" __global__ void normal_mean(DepthNormals p, const double* sums, long long count, float* loss) {
    __shared__ double scratch[kThreads / kWarp];
    const double sum = sum_of_array<kThreads>(sums, count, 1, scratch);
    if (threadIdx.x == 0) *loss = static_cast<float>(1.0 - sum / (static_cast<double>(p.views) * pixel_count(p)));
}

extern "C" __global__ void normal_backward(DepthNormals p, const float* grad_loss, float* grad_normals,
                                           float* grad_depth) {
    const int b = blockIdx.y;
    const long long pixel = static_cast<long long>(blockIdx.x) * kThreads + threadIdx.x;
    if (pixel >= pixel_count(p)) return;
    const DepthView view = depth_view(p.viewmats + 16 * b, p.Ks + 9 * b);
    const int row = static_cast<int>(pixel / p.width), column = static_cast<int>(pixel % p.width);
    const float scale = static_cast<float>(-*grad_loss / (static_cast<double>(p.views) * pixel_count(p)));
    const Vector3<float> by_normal = agreement_at(p, view, b, row, column).by_normal;
    const Vector3<float> by_point = agreement_at(p, view, b, row - 1, column).by_slopes.down -
                                    agreement_at(p, view, b, row + 1, column).by_slopes.down +
                                    agreement_at(p, view, b, row, column - 1).by_slopes.right -
                                    agreement_at(p, view, b, row, column + 1).by_slopes.right;
    const long long at = b * pixel_count(p) + pixel;
    grad_normals[3 * at] = scale * by_normal.x;
    grad_normals[3 * at + 1] = scale * by_normal.y;
    grad_normals[3 * at + 2] = scale * by_normal.z;
    grad_depth[at] = scale * along_ray(view, by_point, static_cast<float>(row), static_cast<float>(column));
}
