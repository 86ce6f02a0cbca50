// Centroid depths and facing normals of triangles, one thread each. Per view 36 bytes read and up to 16 written, backward 52
// read and 36 written: bytes bound both.
#include "cuda/common.h"
#include "math/facing_normal.h"

using namespace etsplat;

struct ChannelsOf {
    const float *corners, *viewmats;  // (N, 3, 3), (B, 4, 4)
    int triangles, views, depth, normals;
};

__device__ void load_corners(const ChannelsOf& p, int n, Vector3<float>* corner) {
    const float* from = p.corners + 9ll * n;
    for (int k = 0; k < 3; ++k) corner[k] = {from[3 * k], from[3 * k + 1], from[3 * k + 2]};
}

// channels (B, N, D)
extern "C" __global__ void triangle_channels_forward(ChannelsOf p, float* channels) {
    const int n = blockIdx.x * blockDim.x + threadIdx.x;
    if (n >= p.triangles) return;
    const int count = p.depth + 3 * p.normals;
    Vector3<float> corner[3];
    load_corners(p, n, corner);
    for (int b = 0; b < p.views; ++b) {
        float* to = channels + (static_cast<long long>(b) * p.triangles + n) * count;
        triangle_channels(depth_axis(p.viewmats + 16 * b), corner, p.depth, p.normals, to);
    }
}

extern "C" __global__ void triangle_channels_gradient(ChannelsOf p, const float* grad_channels, float* grad_corners) {
    const int n = blockIdx.x * blockDim.x + threadIdx.x;
    if (n >= p.triangles) return;
    const int count = p.depth + 3 * p.normals;
    Vector3<float> corner[3], grad[3] = {};
    load_corners(p, n, corner);
    for (int b = 0; b < p.views; ++b) {
        const float* from = grad_channels + (static_cast<long long>(b) * p.triangles + n) * count;
        triangle_channels_backward(depth_axis(p.viewmats + 16 * b), corner, p.depth, p.normals, from, grad);
    }
    float* to = grad_corners + 9ll * n;
    for (int k = 0; k < 3; ++k) {
        to[3 * k] = grad[k].x;
        to[3 * k + 1] = grad[k].y;
        to[3 * k + 2] = grad[k].z;
    }
}
