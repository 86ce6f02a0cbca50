// Centroid depths and facing normals of triangles, which run in parallel.
#include <algorithm>

#include "bindings.h"
#include "math/facing_normal.h"
#include "parallel.h"

namespace etsplat {
namespace {

using Vector = Vector3<float>;

constexpr int64_t kTriangles = 1024;  // that a thread takes at a time

}  // namespace

void bind_triangle_channels(nb::module_& m) {
    // corners (N, 3, 3), viewmats (B, 4, 4), channels (B, N, D), D = depth + 3 normals; all float32.
    m.def(
        "triangle_channels",
        [](Address corners, Address viewmats, int64_t triangles, int64_t views, bool depth, bool normals,
           Address channels) {
            const int64_t count = (depth ? 1 : 0) + (normals ? 3 : 0);
            for (int64_t b = 0; b < views; ++b) {
                const DepthAxis camera = depth_axis(pointer<const float>(viewmats) + 16 * b);
                parallel_for(triangles, kTriangles, [&](int64_t begin, int64_t end) {
                    for (int64_t n = begin; n < end; ++n) {
                        triangle_channels(camera, pointer<const Vector>(corners) + 3 * n, depth, normals,
                                          pointer<float>(channels) + (b * triangles + n) * count);
                    }
                });
            }
        },
        NoGil());
    m.def(
        "triangle_channels_backward",
        [](Address corners, Address viewmats, int64_t triangles, int64_t views, bool depth, bool normals,
           Address grad_channels, Address grad_corners) {
            const int64_t count = (depth ? 1 : 0) + (normals ? 3 : 0);
            parallel_for(triangles, kTriangles, [&](int64_t begin, int64_t end) {
                Vector* grad = pointer<Vector>(grad_corners);
                std::fill(grad + 3 * begin, grad + 3 * end, Vector{});
                for (int64_t b = 0; b < views; ++b) {
                    const DepthAxis camera = depth_axis(pointer<const float>(viewmats) + 16 * b);
                    for (int64_t n = begin; n < end; ++n) {
                        triangle_channels_backward(
                            camera, pointer<const Vector>(corners) + 3 * n, depth, normals,
                            pointer<const float>(grad_channels) + (b * triangles + n) * count, grad + 3 * n);
                    }
                }
            });
        },
        NoGil());
}

}  // namespace etsplat
