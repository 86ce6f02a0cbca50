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
    // corners (N, 3, 3), viewmats (B, 4, 4), channels (B, N, D), D = depth + 3 normals.
    def_function(
        m, "triangle_channels",
        [](Array<const float, 3> corners, Array<const float, 3> viewmats, bool depth, bool normals,
           Array<float, 3> channels) {
            const int64_t triangles = corners.size(0);
            const Vector* corner = reinterpret_cast<const Vector*>(corners.data());
            for (int64_t b = 0; b < viewmats.size(0); ++b) {
                const DepthAxis camera = depth_axis(viewmats.row(b));
                parallel_for(triangles, kTriangles, [&](int64_t begin, int64_t end) {
                    for (int64_t n = begin; n < end; ++n) {
                        triangle_channels(camera, corner + 3 * n, depth, normals,
                                          channels.data() + (b * triangles + n) * channels.size(2));
                    }
                });
            }
        },
        "corners", "viewmats", "depth", "normals", "channels");
    def_function(
        m, "triangle_channels_backward",
        [](Array<const float, 3> corners, Array<const float, 3> viewmats, bool depth, bool normals,
           Array<const float, 3> grad_channels, Array<float, 3> grad_corners) {
            const int64_t triangles = corners.size(0);
            const Vector* corner = reinterpret_cast<const Vector*>(corners.data());
            parallel_for(triangles, kTriangles, [&](int64_t begin, int64_t end) {
                Vector* grad = reinterpret_cast<Vector*>(grad_corners.data());
                std::fill(grad + 3 * begin, grad + 3 * end, Vector{});
                for (int64_t b = 0; b < viewmats.size(0); ++b) {
                    const DepthAxis camera = depth_axis(viewmats.row(b));
                    for (int64_t n = begin; n < end; ++n) {
                        triangle_channels_backward(
                            camera, corner + 3 * n, depth, normals,
                            grad_channels.data() + (b * triangles + n) * grad_channels.size(2), grad + 3 * n);
                    }
                }
            });
        },
        "corners", "viewmats", "depth", "normals", "grad_channels", "grad_corners");
}

}  // namespace etsplat
