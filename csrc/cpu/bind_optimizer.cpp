// Adam and the photometric loss: both stream through memory once.
//
// Adam: all parameters of a step in one call, cut into pieces of kAdamPiece elements that threads take one by one;
// every element is independent. Photometric loss: pieces of kPixels pixels leave their sums, which are added in order.
#include <algorithm>
#include <cmath>
#include <vector>

#include "bindings.h"
#include "math/adam.h"
#include "math/photometric.h"
#include "parallel.h"

namespace etsplat {
namespace {

constexpr int64_t kAdamPiece = 16384;

struct AdamGroup {
    float* parameter;
    const float* gradient;
    float* first;
    float* second;
    int64_t size;
    AdamCoefficients<float> coefficients;
};

void adam_range(const AdamGroup& group, int64_t begin, int64_t end) {
    float* __restrict parameter = group.parameter;
    const float* __restrict gradient = group.gradient;
    float* __restrict first = group.first;
    float* __restrict second = group.second;
    const AdamCoefficients<float> coefficients = group.coefficients;
    for (int64_t i = begin; i < end; ++i) {
        adam_update(parameter[i], first[i], second[i], gradient[i], coefficients);
    }
}

void adam_step(const std::vector<AdamGroup>& groups) {
    struct Piece {
        const AdamGroup* group;
        int64_t begin;
    };
    std::vector<Piece> pieces;
    for (const AdamGroup& group : groups) {
        for (int64_t begin = 0; begin < group.size; begin += kAdamPiece) pieces.push_back({&group, begin});
    }
    parallel_for(static_cast<int64_t>(pieces.size()), 1, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) {
            const auto& [group, first] = pieces[i];
            adam_range(*group, first, std::min(first + kAdamPiece, group->size));
        }
    });
}

constexpr int64_t kPixels = 4096;  // of a piece
constexpr int kBlock = 64;         // pixels whose target is composited into a local array
constexpr int kLanes = 16;

// Sum of |color - (target + (1 - a) background)| over `pixels` <= kBlock pixels; with a gradient, also scale * sign.
template <bool WithGradient>
double l1_block(const float* color, const float* target, const float* background, int64_t pixels, float scale,
                float* gradient) {
    float composited[3 * kBlock];
    for (int64_t p = 0; p < pixels; ++p) {
        const float rest = 1.0f - target[4 * p + 3];
        for (int c = 0; c < 3; ++c) composited[3 * p + c] = over_background(target[4 * p + c], rest, background[c]);
    }
    float lanes[kLanes] = {};
    const int64_t values = 3 * pixels, whole = values / kLanes * kLanes;
    const auto add = [&](int64_t i, float& sum) {
        const float difference = color[i] - composited[i];
        sum += std::fabs(difference);
        if constexpr (WithGradient) gradient[i] = l1_gradient(difference, scale);
    };
    for (int64_t i = 0; i < whole; i += kLanes) {
        for (int lane = 0; lane < kLanes; ++lane) add(i + lane, lanes[lane]);
    }
    for (int64_t i = whole; i < values; ++i) add(i, lanes[i - whole]);
    double sum = 0.0;
    for (const float lane : lanes) sum += lane;
    return sum;
}

template <bool WithGradient>
double l1_over_background(const float* color, const float* target, const float* backgrounds, int64_t views,
                          int64_t pixels, float* gradient) {
    const int64_t per_view = (pixels + kPixels - 1) / kPixels;
    const double count = 3.0 * static_cast<double>(views) * static_cast<double>(pixels);
    std::vector<double> sums(views * per_view, 0.0);
    parallel_for(views * per_view, 4, [&](int64_t begin, int64_t end) {
        for (int64_t piece = begin; piece < end; ++piece) {
            const int64_t view = piece / per_view, first = (piece % per_view) * kPixels;
            for (int64_t p = first; p < std::min(first + kPixels, pixels); p += kBlock) {
                const int64_t at = view * pixels + p, n = std::min<int64_t>({kBlock, first + kPixels - p, pixels - p});
                sums[piece] += l1_block<WithGradient>(color + 3 * at, target + 4 * at, backgrounds + 3 * view, n,
                                                      static_cast<float>(1.0 / count),
                                                      WithGradient ? gradient + 3 * at : nullptr);
            }
        }
    });
    double total = 0.0;
    for (const double sum : sums) total += sum;
    return total / count;
}

}  // namespace

void bind_optimizer(nb::module_& m) {
    // Addresses of float32 arrays, one entry per parameter; `step` counts from 1.
    m.def(
        "adam_step",
        [](const std::vector<Address>& parameters, const std::vector<Address>& gradients,
           const std::vector<Address>& firsts, const std::vector<Address>& seconds, const std::vector<int64_t>& sizes,
           const std::vector<double>& learning_rates, double beta1, double beta2, double eps, int64_t step) {
            const double first_correction = 1.0 - std::pow(beta1, static_cast<double>(step));
            const double second_correction = std::sqrt(1.0 - std::pow(beta2, static_cast<double>(step)));
            std::vector<AdamGroup> groups;
            for (size_t i = 0; i < sizes.size(); ++i) {
                AdamCoefficients<float> k;
                k.first_weight = static_cast<float>(1.0 - beta1);
                k.second_decay = static_cast<float>(beta2);
                k.second_weight = static_cast<float>(1.0 - beta2);
                k.step_size = static_cast<float>(learning_rates[i] / first_correction);
                k.second_correction = static_cast<float>(second_correction);
                k.eps = static_cast<float>(eps);
                groups.push_back({pointer<float>(parameters[i]), pointer<const float>(gradients[i]),
                                  pointer<float>(firsts[i]), pointer<float>(seconds[i]), sizes[i], k});
            }
            adam_step(groups);
        },
        NoGil());
    // color (B, P, 3), target (B, P, 4), backgrounds (B, 3), gradient (B, P, 3) or 0, all float32; the mean.
    m.def(
        "l1_over_background",
        [](Address color, Address target, Address backgrounds, int64_t views, int64_t pixels, Address gradient) {
            const auto run = gradient ? l1_over_background<true> : l1_over_background<false>;
            return run(pointer<const float>(color), pointer<const float>(target), pointer<const float>(backgrounds),
                       views, pixels, pointer<float>(gradient));
        },
        NoGil());
}

}  // namespace etsplat
