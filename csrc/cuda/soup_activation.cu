// Opacity and softness of a soup's triangles, one thread each. 44 bytes read where triangles are left out by size, else 8,
// and 8 written; bytes bound it.
#include "cuda/common.h"
#include "math/soup_activation.h"

using namespace etsplat;

// logits, raw (N); numbers (4): those of SoupNumbers, in their order. viewmat (4, 4), K (3, 3) of the camera for which those
// of the triangles (N, 3, 3) get opacity 0 that are smaller or larger than this, or null.
extern "C" __global__ void soup_activate(int triangles, const float* vertices, const float* logits, const float* raw,
                                         const float* viewmat, const float* K, float smallest, float largest,
                                         const float* numbers, float* opacities, float* sigma) {
    const int n = blockIdx.x * blockDim.x + threadIdx.x;
    if (n >= triangles) return;
    const SoupNumbers given{numbers[0], numbers[1], numbers[2], numbers[3]};
    const Activated drawn = activate(logits[n], raw[n], given);
    float world[9];
    for (int i = 0; i < 9 && viewmat; ++i) world[i] = vertices[9ll * n + i];
    const bool left_out = viewmat && is_left_out(pinhole_camera(viewmat, K), world, {smallest, largest});
    opacities[n] = left_out || is_dropped(n, given) ? 0.0f : drawn.opacity;
    sigma[n] = drawn.sigma;
}

// An opacity of 0 belongs to a triangle that was left out.
extern "C" __global__ void soup_activate_backward(int triangles, const float* logits, const float* raw,
                                                  const float* opacities, const float* numbers,
                                                  const float* grad_opacities, const float* grad_sigma,
                                                  float* grad_logits, float* grad_raw) {
    const int n = blockIdx.x * blockDim.x + threadIdx.x;
    if (n >= triangles) return;
    const Activated grad{grad_opacities && opacities[n] > 0.0f ? grad_opacities[n] : 0.0f,
                         grad_sigma ? grad_sigma[n] : 0.0f};
    const SoupNumbers given{numbers[0], numbers[1], numbers[2], numbers[3]};
    const Activated result = activate_backward(logits[n], raw[n], given, grad);
    grad_logits[n] = result.opacity;
    grad_raw[n] = result.sigma;
}
