// Planes run in parallel, then rows: each has its own place in memory, so bits do not depend on the threads.
#include <algorithm>
#include <stdexcept>
#include <utility>
#include <vector>

#include "bindings.h"
#include "buffer.h"
#include "instruction_set.h"
#include "parallel.h"
#include "scratch.h"

namespace etsplat {
namespace {

// The pixels around each place between pixels, 0 beyond the photo.
Scratch<float> quads_of(const Array<const float, 2>& grey) {
    const int64_t height = grey.size(0), width = grey.size(1), across = width + 2;
    Scratch<float> quads(4 * (height + 2) * across);
    std::fill(quads.begin(), quads.end(), 0.0f);
    for (int64_t y = 0; y < height; ++y) {
        for (int64_t x = 0; x < width; ++x) {
            const float value = grey.data()[y * width + x];
            for (int64_t k = 0; k < 4; ++k) {  // this pixel is the last of the quad at (y, x), the first of (y + 1, x + 1)
                quads[4 * ((y + k / 2) * across + x + k % 2) + 3 - k] = value;
            }
        }
    }
    return quads;
}

// Rows with a stride, 0 beyond the photo.
Scratch<float> padded(const float* rows, int64_t height, int64_t width, int64_t stride) {
    Scratch<float> out(height * stride);
    std::fill(out.begin(), out.end(), 0.0f);
    for (int64_t y = 0; y < height; ++y) std::copy_n(rows + y * width, width, out.data() + y * stride);
    return out;
}

// 1 over how many places of a window are within a size, and 0 beyond it.
std::vector<float> shares(int64_t size, int64_t reach, int64_t stride) {
    std::vector<float> found(static_cast<size_t>(stride), 0.0f);
    for (int64_t i = 0; i < size; ++i) {
        const int64_t count = 1 + std::min(i, reach) + std::min(size - 1 - i, reach);
        found[static_cast<size_t>(i)] = 1.0f / static_cast<float>(count);
    }
    return found;
}

void run(const PlaneSweep& sweep, const SweptPlanes& out) {
    const PlaneSweepKernels& kernels = active_plane_sweep_kernels();
    parallel_for(sweep.planes, 1, [&](int64_t begin, int64_t end) {
        thread_local Buffer<float> scratch;
        scratch.resize(plane_sweep_scratch(sweep));
        for (int64_t plane = begin; plane < end; ++plane) kernels.judge(sweep, plane, scratch.data());
    });
    parallel_for(sweep.height, 4, [&](int64_t begin, int64_t end) {
        for (int64_t row = begin; row < end; ++row) kernels.choose(sweep, row, out);
    });
}

}  // namespace

void bind_plane_sweep(nb::module_& m) {
    // grey, mean and variance (H, W), N neighbours (h, w), rays (N, 3, 3), starts (N, 3), inverse (D,); place, best and
    // elsewhere (H, W).
    def_function(
        m, "plane_sweep",
        [](Array<const float, 2> grey, Array<const float, 2> mean, Array<const float, 2> variance,
           const std::vector<Array<const float, 2>>& neighbours, Array<const float, 3> rays,
           Array<const float, 2> starts, Array<const float, 1> inverse, int64_t window, int64_t agreeing,
           int64_t beside, float least_variance, float least_depth, Array<float, 2> place, Array<float, 2> best, Array<float, 2> elsewhere) {
            const auto count = static_cast<int64_t>(neighbours.size());
            if (count < agreeing || count > kMostSwept || window > 2 * kSweepLanes) {
                throw std::invalid_argument("plane_sweep: too few or too many neighbours, or too wide a window");
            }
            const int64_t height = grey.size(0), width = grey.size(1), reach = window / 2;
            const int64_t stride = (width + kSweepLanes - 1) / kSweepLanes * kSweepLanes;
            const Scratch<float> shown = padded(grey.data(), height, width, stride);
            const Scratch<float> means = padded(mean.data(), height, width, stride);
            const Scratch<float> variances = padded(variance.data(), height, width, stride);
            const std::vector<float> across = shares(width, reach, stride), down = shares(height, reach, height);
            std::vector<Scratch<float>> quads;
            std::vector<SweptNeighbour> others;
            for (int64_t k = 0; k < count; ++k) {
                const auto& other = neighbours[static_cast<size_t>(k)];
                quads.push_back(quads_of(other));
                others.push_back({quads.back().begin(), other.size(1), other.size(0), rays.row(k), starts.row(k)});
            }
            Scratch<float> judged(height * inverse.size(0) * stride);
            run({shown.begin(), means.begin(), variances.begin(), across.data(), down.data(), width, height, stride,
                 std::move(others), reach, agreeing, beside, least_variance, least_depth,
                 inverse.data(), inverse.size(0), judged.data()},
                {place.data(), best.data(), elsewhere.data()});
        },
        "grey", "mean", "variance", "neighbours", "rays", "starts", "inverse", "window", "agreeing", "beside",
        "least_variance", "least_depth", "place", "best", "elsewhere");
}

}  // namespace etsplat
