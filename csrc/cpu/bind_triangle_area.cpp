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
    // vertices and gradient (N, 3, 3); the mean area.
    def_function(
        m, "mean_area",
        [](Array<const float, 3> vertices, Array<float, 3> gradient) {
            const int64_t count = vertices.size(0);
            std::vector<double> sums(static_cast<size_t>((count + kRange - 1) / kRange), 0.0);
            parallel_for(count, kRange, [&](int64_t begin, int64_t end) {
                double sum = 0.0;
                for (int64_t n = begin; n < end; ++n) {
                    sum += area_with_gradient(reinterpret_cast<const Vector*>(vertices.row(n)),
                                              1.0f / static_cast<float>(count),
                                              reinterpret_cast<Vector*>(gradient.row(n)));
                }
                sums[static_cast<size_t>(begin / kRange)] = sum;
            });
            double total = 0.0;
            for (const double sum : sums) total += sum;
            return total / static_cast<double>(count);
        },
        "vertices", "gradient");
}

}  // namespace etsplat
