// Mean area of separate triangles with its gradient. Ranges have places of their own; their sums are added in order.
#include <cmath>
#include <vector>

#include "bindings.h"
#include "math/vector3.h"
#include "parallel.h"

namespace etsplat {
namespace {

using Vector = Vector3<float>;

constexpr int64_t kRange = 2048;

// Area of (a, b, c) and its gradient: with n the unit normal, dA/da = n x (c - b) / 2, and so on around.
float area_with_gradient(const Vector* corner, float scale, Vector* gradient) {
    const Vector a = corner[0], b = corner[1], c = corner[2];
    float doubled;
    const Vector n = direction(cross(b - a, c - a), doubled);
    gradient[0] = 0.5f * scale * cross(n, c - b);
    gradient[1] = 0.5f * scale * cross(n, a - c);
    gradient[2] = 0.5f * scale * cross(n, b - a);
    return 0.5f * doubled;
}

}  // namespace

void bind_triangle_area(nb::module_& m) {
    // vertices and gradient (N, 3, 3) float32; the mean area.
    m.def(
        "mean_area",
        [](Address vertices, int64_t count, Address gradient) {
            std::vector<double> sums(static_cast<size_t>((count + kRange - 1) / kRange), 0.0);
            parallel_for(count, kRange, [&](int64_t begin, int64_t end) {
                double sum = 0.0;
                for (int64_t n = begin; n < end; ++n) {
                    sum += area_with_gradient(pointer<const Vector>(vertices) + 3 * n, 1.0f / static_cast<float>(count),
                                              pointer<Vector>(gradient) + 3 * n);
                }
                sums[static_cast<size_t>(begin / kRange)] = sum;
            });
            double total = 0.0;
            for (const double sum : sums) total += sum;
            return total / static_cast<double>(count);
        },
        NoGil());
}

}  // namespace etsplat
