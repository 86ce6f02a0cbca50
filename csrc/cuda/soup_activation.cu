// Opacity and softness of a soup's triangles, one thread each. 44 bytes read where triangles are left out by size, else 8,
// and 8 written; bytes bound it.
#include "cuda/common.h"
#include "math/soup_activation.h"

using namespace etsplat;

// logits, raw (N); limits (2): opacity floor and sigma ceiling. viewmat (4, 4), K (3, 3) of the camera for which those of the
// triangles (N, 3, 3) get opacity 0 that are smaller or larger than this, or null.
extern "C" __global__ void soup_activate(int triangles, const float* vertices, const float* logits, const float* raw,
                                         const float* viewmat, const float* K, float smallest, float largest,
                                         const float* limits, float* opacities, float* sigma) {
    const int n = blockIdx.x * blockDim.x + threadIdx.x;
    if (n >= triangles) return;
    const Activated drawn = activate(logits[n], raw[n], {limits[0], limits[1]});
    float world[9];
    for (int i = 0; i < 9 && viewmat; ++i) world[i] = vertices[9ll * n + i];
    opacities[n] = viewmat && is_left_out(pinhole_camera(viewmat, K), world, {smallest, largest}) ? 0.0f : drawn.opacity;
    sigma[n] = drawn.sigma;
}

// An opacity of 0 belongs to a triangle that was left out.
extern "C" __global__ void soup_activate_backward(int triangles, const float* logits, const float* raw,
                                                  const float* opacities, const float* limits,
                                                  const float* grad_opacities, const float* grad_sigma,
                                                  float* grad_logits, float* grad_raw) {
    const int n = blockIdx.x * blockDim.x + threadIdx.x;
    if (n >= triangles) return;
    const Activated grad{grad_opacities && opacities[n] > 0.0f ? grad_opacities[n] : 0.0f,
                         grad_sigma ? grad_sigma[n] : 0.0f};
    const Activated result = activate_backward(logits[n], raw[n], {limits[0], limits[1]}, grad);
    grad_logits[n] = result.opacity;
    grad_raw[n] = result.sigma;
}
