// Bands of rows run in parallel (simd/photometric.h); their sums are added in order.
#include <vector>

#include "bindings.h"
#include "buffer.h"
#include "instruction_set.h"
#include "parallel.h"
#include "photometric_pass.h"

namespace etsplat {

namespace {

PhotometricSums photometric(const PhotometricPass& pass, int64_t views) {
    const int64_t bands = (pass.height + kBandRows - 1) / kBandRows;
    std::vector<PhotometricSums> sums(static_cast<size_t>(views * bands));
    const PhotometricKernels::Band run = active_photometric_kernels().band;
    parallel_for(views * bands, 1, [&](int64_t begin, int64_t end) {
        thread_local Buffer<float> scratch;
        scratch.resize(photometric_scratch_size(pass.width));
        for (int64_t piece = begin; piece < end; ++piece) {
            const int64_t first = piece % bands * kBandRows, last = std::min(first + kBandRows, pass.height);
            sums[static_cast<size_t>(piece)] = run(pass, piece / bands, first, last, scratch.data());
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
    // color (B, H, W, 3) float32; target (B, H, W, channels) bytes or float32; backgrounds (B, 3), mask (B, H, W) and
    // gradient (B, H, W, 3), each float32 or 0. The loss.
    m.def(
        "photometric",
        [](Address color, Address target, Address backgrounds, Address mask, Address gradient, int64_t views,
           int64_t height, int64_t width, int channels, bool bytes, bool squared, double dssim_weight) {
            const double count = 3.0 * static_cast<double>(views * height * width);
            const PhotometricPass pass{pointer<const float>(color),
                                       pointer<const void>(target),
                                       pointer<const float>(backgrounds),
                                       pointer<const float>(mask),
                                       pointer<float>(gradient),
                                       height,
                                       width,
                                       channels,
                                       bytes,
                                       squared,
                                       static_cast<float>((1.0 - dssim_weight) / count),
                                       static_cast<float>(dssim_weight / count)};
            const PhotometricSums sums = photometric(pass, views);
            return (1.0 - dssim_weight) * sums.pixel / count + dssim_weight * (1.0 - sums.ssim / count);
        },
        NoGil());
}

}  // namespace etsplat
