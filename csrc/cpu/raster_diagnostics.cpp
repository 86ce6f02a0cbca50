#include "raster_diagnostics.h"

#include <algorithm>
#include <chrono>
#include <stdexcept>

#include "instruction_set.h"
#include "math/kernels.h"

namespace etsplat {

TileCounts count_tiles(const RasterState& state) {
    const RasterPass& pass = state.pass;
    Buffer<float> scratch;
    scratch.resize(pass.scratch_size());
    TileCounts counts;
    for (int tile = 0; tile < pass.tiles_x * pass.tiles_y; ++tile)
        active_raster_kernels().count[pass.kernel](pass, tile, scratch.data(), counts);
    return counts;
}

std::vector<std::string> kernel_names() {
#define ETSPLAT_NAME(K) #K,
    return {ETSPLAT_KERNELS(ETSPLAT_NAME)};
#undef ETSPLAT_NAME
}

KernelNanoseconds time_kernel(int kernel, float sigma) {
    if (kernel < 0 || kernel >= kKernels - 1) throw std::invalid_argument("time_kernel: no such kernel");
    constexpr const float* table = nullptr;
    constexpr int kCount = 1024, kLoops = 100, kRuns = 50;
    alignas(64) float x[kCount], out[kCount];
    for (int i = 0; i < kCount; ++i) x[i] = 2.0f * (static_cast<float>(i) + 0.5f) / kCount;
    KernelCoefficients<float> coefficients{};
    int index = 0;
#define ETSPLAT_CASE(K) \
    if (kernel == index++) coefficients = kernel_with<K>(table).coefficients(sigma);
    ETSPLAT_KERNELS(ETSPLAT_CASE)
#undef ETSPLAT_CASE
    const auto best = [&](EvaluationLoop loop) {
        double seconds = 1e30;
        for (int run = 0; run < kRuns; ++run) {
            const auto start = std::chrono::steady_clock::now();
            for (int i = 0; i < kLoops; ++i) loop(table, x, kCount, coefficients.exponent, coefficients.scale, out);
            const std::chrono::duration<double> elapsed = std::chrono::steady_clock::now() - start;
            seconds = std::min(seconds, elapsed.count());
        }
        return 1e9 * seconds / (kLoops * kCount / 16);
    };
    const RasterKernels& kernels = active_raster_kernels();
    return {best(kernels.value_loop[kernel]), best(kernels.gradient_loop[kernel])};
}

}  // namespace etsplat
