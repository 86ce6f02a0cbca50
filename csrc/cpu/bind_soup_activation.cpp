// Opacity and softness of a soup's triangles, which run in parallel.
#include <nanobind/stl/array.h>

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
    // vertices (N, 3, 3); logits, raw, opacities and sigma (N,); viewmats (1, 4, 4) and Ks (1, 3, 3) of the camera for which
    // triangles smaller or larger than this get opacity 0, or neither; numbers those of SoupNumbers, in their order.
    def_function(
        m, "soup_activate",
        [](Array<const float, 3> vertices, Array<const float, 1> logits, Array<const float, 1> raw,
           OptionalArray<const float, 3> viewmats, OptionalArray<const float, 3> Ks, float smallest, float largest,
           std::array<float, 4> numbers, Array<float, 1> opacities, Array<float, 1> sigma) {
            const SoupNumbers given{numbers[0], numbers[1], numbers[2], numbers[3]};
            PinholeCamera camera{};
            if (viewmats) camera = pinhole_camera(viewmats->data(), Ks.value().data());
            for_each_triangle(logits.count(), [&](int64_t n) {
                const Activated drawn = activate(logits.data()[n], raw.data()[n], given);
                const bool left_out = viewmats && is_left_out(camera, vertices.row(n), {smallest, largest});
                opacities.data()[n] = left_out || is_dropped(static_cast<unsigned>(n), given) ? 0.0f : drawn.opacity;
                sigma.data()[n] = drawn.sigma;
            });
        },
        "vertices", "logits", "raw", "viewmats", "Ks", "smallest", "largest", "numbers", "opacities", "sigma");
    // All (N,). An opacity of 0 belongs to a triangle that was left out.
    def_function(
        m, "soup_activate_backward",
        [](Array<const float, 1> logits, Array<const float, 1> raw, Array<const float, 1> opacities,
           std::array<float, 4> numbers, OptionalArray<const float, 1> grad_opacities,
           OptionalArray<const float, 1> grad_sigma, Array<float, 1> grad_logits, Array<float, 1> grad_raw) {
            const SoupNumbers given{numbers[0], numbers[1], numbers[2], numbers[3]};
            for_each_triangle(logits.count(), [&](int64_t n) {
                const bool drawn = opacities.data()[n] > 0.0f;
                const Activated grad{grad_opacities && drawn ? grad_opacities->data()[n] : 0.0f,
                                     grad_sigma ? grad_sigma->data()[n] : 0.0f};
                const Activated result = activate_backward(logits.data()[n], raw.data()[n], given, grad);
                grad_logits.data()[n] = result.opacity;
                grad_raw.data()[n] = result.sigma;
            });
        },
        "logits", "raw", "opacities", "numbers", "grad_opacities", "grad_sigma", "grad_logits", "grad_raw");
}

}  // namespace etsplat
