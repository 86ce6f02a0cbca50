// Each thread takes rows in one sweep (simd/photometric.h), as many as leave something for the others: twenty more are
// read around them. Sums are of bands of rows, however they are shared out, and added in order.
#include <algorithm>
#include <vector>

#include "bindings.h"
#include "buffer.h"
#include "instruction_set.h"
#include "parallel.h"
#include "photometric_pass.h"

namespace etsplat {

namespace {

PhotometricSums photometric(const PhotometricPass& pass, int64_t views) {
    const int64_t bands = (pass.height + kBandRows - 1) / kBandRows;  // of a view
    const int64_t together = std::min(bands, (views * bands + num_threads() - 1) / num_threads());
    const int64_t sweeps = (bands + together - 1) / together;
    std::vector<PhotometricSums> sums(static_cast<size_t>(views * bands), {0.0, 0.0});
    const PhotometricKernels::Sweep run = active_photometric_kernels().sweep;
    parallel_for(views * sweeps, 1, [&](int64_t begin, int64_t end) {
        thread_local Buffer<float> scratch;
        scratch.resize(photometric_scratch_size(pass.width));
        for (int64_t piece = begin; piece < end; ++piece) {
            const int64_t view = piece / sweeps, band = piece % sweeps * together;
            const int64_t last = std::min((band + together) * kBandRows, pass.height);
            run(pass, view, band * kBandRows, last, scratch.data(), sums.data() + view * bands + band);
        }
    });
    PhotometricSums total{0.0, 0.0};
    for (const PhotometricSums& sum : sums) {
        total.pixel += sum.pixel;
        total.ssim += sum.ssim;
    }
    return total;
}

}  // namespace

void bind_photometric(nb::module_& m) {
    // color and gradient (B, H, W, 3), target (B, H, W, channels), backgrounds (B, 3), mask (B, H, W). The loss.
    def_function(
        m, "photometric",
        [](Array<const float, 4> color, EitherArray<const uint8_t, const float, 4> target,
           OptionalArray<const float, 2> backgrounds, OptionalArray<const float, 3> mask,
           OptionalArray<float, 4> gradient, bool squared, double dssim_weight) {
            const double count = static_cast<double>(color.count());
            const PhotometricPass pass{color.data(),
                                       target.data(),
                                       data_or_null(backgrounds),
                                       data_or_null(mask),
                                       data_or_null(gradient),
                                       color.size(1),
                                       color.size(2),
                                       static_cast<int>(target.size(3)),
                                       target.is<const uint8_t>(),
                                       squared,
                                       static_cast<float>((1.0 - dssim_weight) / count),
                                       static_cast<float>(dssim_weight / count)};
            const PhotometricSums sums = photometric(pass, color.size(0));
            return (1.0 - dssim_weight) * sums.pixel / count + dssim_weight * (1.0 - sums.ssim / count);
        },
        "color", "target", "backgrounds", "mask", "gradient", "squared", "dssim_weight");
}

}  // namespace etsplat
