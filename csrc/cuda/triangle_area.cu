// Mean area of separate triangles. 36 bytes read of each, backward 36 read and 36 written: bytes bound both.
#include "cuda/block_sum.h"
#include "math/triangle_area.h"

using namespace etsplat;

constexpr int kThreads = kBlock;

__device__ float area_of(const float* vertices, int n, float scale, Vector3<float>* gradient) {
    const float* from = vertices + 9ll * n;
    Vector3<float> corner[3];
    for (int k = 0; k < 3; ++k) corner[k] = {from[3 * k], from[3 * k + 1], from[3 * k + 2]};
    return area_with_gradient(corner, scale, gradient);
}

extern "C" __global__ void area_sums(const float* vertices, int triangles, double* sums) {
    __shared__ double scratch[kThreads / kWarp];
    const int n = blockIdx.x * kThreads + threadIdx.x;
    Vector3<float> unused[3];
    const double sum = block_sum<kThreads>(n < triangles ? area_of(vertices, n, 0.0f, unused) : 0.0, scratch);
    if (threadIdx.x == 0) sums[blockIdx.x] = sum;
}

// One block.
extern "C" __global__ void area_mean(const double* sums, long long count, int triangles, float* mean) {
    __shared__ double scratch[kThreads / kWarp];
    const double sum = sum_of_array<kThreads>(sums, count, 1, scratch);
    if (threadIdx.x == 0) *mean = static_cast<float>(sum / triangles);
}

extern "C" __global__ void area_backward(const float* vertices, int triangles, const float* grad_mean, float* gradient) {
    const int n = blockIdx.x * kThreads + threadIdx.x;
    if (n >= triangles) return;
    Vector3<float> by_corner[3];
    area_of(vertices, n, *grad_mean / static_cast<float>(triangles), by_corner);
    float* to = gradient + 9ll * n;
    for (int k = 0; k < 3; ++k) {
        to[3 * k] = by_corner[k].x;
        to[3 * k + 1] = by_corner[k].y;
        to[3 * k + 2] = by_corner[k].z;
    }
}
