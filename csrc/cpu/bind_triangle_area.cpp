// Mean area of separate triangles with its gradient. Ranges have places of their own; their sums are added in order.
#include <vector>

#include "bindings.h"
#include "math/triangle_area.h"
#include "parallel.h"

namespace etsplat {
namespace {

using Vector = Vector3<float>;

constexpr int64_t kRange = 2048;

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
