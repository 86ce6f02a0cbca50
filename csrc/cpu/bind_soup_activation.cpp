// Opacity and softness of a soup's triangles, which run in parallel.
#include "bindings.h"
#include "math/soup_activation.h"
#include "parallel.h"

namespace etsplat {
namespace {

constexpr int64_t kTriangles = 2048;  // that a thread takes at a time

template <class Body>
void for_each_triangle(int64_t triangles, const Body& body) {
    parallel_for(triangles, kTriangles, [&](int64_t begin, int64_t end) {
        for (int64_t n = begin; n < end; ++n) body(n);
    });
}

}  // namespace

void bind_soup_activation(nb::module_& m) {
    // vertices (N, 3, 3), logits, raw, opacities, sigma (N) float32; viewmat (4, 4) and K (3, 3) of the camera for which
    // triangles smaller or larger than this get opacity 0, or 0.
    m.def(
        "soup_activate",
        [](int64_t triangles, Address vertices, Address logits, Address raw, Address viewmat, Address K,
           float smallest, float largest, float opacity_floor, float sigma_ceiling, Address opacities, Address sigma) {
            PinholeCamera camera{};
            if (viewmat) camera = pinhole_camera(pointer<const float>(viewmat), pointer<const float>(K));
            for_each_triangle(triangles, [&](int64_t n) {
                const Activated drawn = activate(pointer<const float>(logits)[n], pointer<const float>(raw)[n],
                                                 {opacity_floor, sigma_ceiling});
                const bool left_out = viewmat && is_left_out(camera, pointer<const float>(vertices) + 9 * n, {smallest, largest});
                pointer<float>(opacities)[n] = left_out ? 0.0f : drawn.opacity;
                pointer<float>(sigma)[n] = drawn.sigma;
            });
        },
        NoGil());
    // An opacity of 0 belongs to a triangle that was left out. Gradients of the outputs may be 0.
    m.def(
        "soup_activate_backward",
        [](int64_t triangles, Address logits, Address raw, Address opacities, float opacity_floor, float sigma_ceiling,
           Address grad_opacities, Address grad_sigma, Address grad_logits, Address grad_raw) {
            for_each_triangle(triangles, [&](int64_t n) {
                const bool drawn = pointer<const float>(opacities)[n] > 0.0f;
                const Activated grad{grad_opacities && drawn ? pointer<const float>(grad_opacities)[n] : 0.0f,
                                     grad_sigma ? pointer<const float>(grad_sigma)[n] : 0.0f};
                const Activated result =
                    activate_backward(pointer<const float>(logits)[n], pointer<const float>(raw)[n],
                                      {opacity_floor, sigma_ceiling}, grad);
                pointer<float>(grad_logits)[n] = result.opacity;
                pointer<float>(grad_raw)[n] = result.sigma;
            });
        },
        NoGil());
}

}  // namespace etsplat
