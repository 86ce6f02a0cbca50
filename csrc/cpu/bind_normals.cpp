// Bands of rows run in parallel (simd/normals.h); their sums are added in order.
#include <algorithm>
#include <vector>

#include "bindings.h"
#include "buffer.h"
#include "instruction_set.h"
#include "parallel.h"

namespace etsplat {

void bind_normals(nb::module_& m) {
    // Of one view: normals (H, W, 3), depth and alpha (H, W), viewmat (4, 4), K (3, 3), by_normals (H, W, 3) and by_depth
    // (H, W) or 0. The sum of the agreements.
    m.def(
        "normal_agreement",
        [](Address normals, Address depth, Address alpha, Address viewmat, Address K, int64_t height, int64_t width,
           Address by_normals, Address by_depth) {
            const NormalsPass pass{pointer<const float>(normals),
                                   pointer<const float>(depth),
                                   pointer<const float>(alpha),
                                   pointer<float>(by_normals),
                                   pointer<float>(by_depth),
                                   height,
                                   width,
                                   depth_view(pointer<const float>(viewmat), pointer<const float>(K))};
            const int64_t bands = (height + kNormalRows - 1) / kNormalRows;
            std::vector<double> sums(static_cast<size_t>(bands));
            const NormalsKernels::Band run = active_normals_kernels().band;
            parallel_for(bands, 1, [&](int64_t begin, int64_t end) {
                thread_local Buffer<float> scratch;
                scratch.resize(NormalsKernels::scratch_size(width));
                for (int64_t band = begin; band < end; ++band) {
                    const int64_t first = band * kNormalRows, last = std::min(first + kNormalRows, height);
                    sums[static_cast<size_t>(band)] = run(pass, first, last, scratch.data());
                }
            });
            double total = 0.0;
            for (const double sum : sums) total += sum;
            return total;
        },
        NoGil());
}

}  // namespace etsplat
