// Bands of rows run in parallel (simd/normals.h); their sums are added in order.
#include <algorithm>
#include <vector>

#include "bindings.h"
#include "buffer.h"
#include "instruction_set.h"
#include "parallel.h"

namespace etsplat {

namespace {

double normal_agreement(const NormalsPass& pass) {
    const int64_t bands = (pass.height + kNormalRows - 1) / kNormalRows;
    std::vector<double> sums(static_cast<size_t>(bands));
    const NormalsKernels::Band run = active_normals_kernels().band;
    parallel_for(bands, 1, [&](int64_t begin, int64_t end) {
        thread_local Buffer<float> scratch;
        scratch.resize(NormalsKernels::scratch_size(pass.width));
        for (int64_t band = begin; band < end; ++band) {
            const int64_t first = band * kNormalRows, last = std::min(first + kNormalRows, pass.height);
            sums[static_cast<size_t>(band)] = run(pass, first, last, scratch.data());
        }
    });
    double total = 0.0;
    for (const double sum : sums) total += sum;
    return total;
}

}  // namespace

void bind_normals(nb::module_& m) {
    // normals and by_normals (B, H, W, 3), depth, alpha and by_depth (B, H, W, 1), viewmats (B, 4, 4), Ks (B, 3, 3). The sum
    // of the agreements; both or none of its derivatives.
    def_function(
        m, "normal_agreement",
        [](Array<const float, 4> normals, Array<const float, 4> depth, Array<const float, 4> alpha,
           Array<const float, 3> viewmats, Array<const float, 3> Ks, OptionalArray<float, 4> by_normals,
           OptionalArray<float, 4> by_depth) {
            double total = 0.0;
            for (int64_t b = 0; b < normals.size(0); ++b) {
                total += normal_agreement({normals.row(b), depth.row(b), alpha.row(b), row_or_null(by_normals, b),
                                           row_or_null(by_depth, b), normals.size(1), normals.size(2),
                                           depth_view(viewmats.row(b), Ks.row(b))});
            }
            return total;
        },
        "normals", "depth", "alpha", "viewmats", "Ks", "by_normals", "by_depth");
}

}  // namespace etsplat
