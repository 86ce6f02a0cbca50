// Adam: all parameters of a step in one call, cut into pieces of kPiece elements that threads take one by one; every
// element is independent.
#include <algorithm>
#include <cmath>
#include <vector>

#include "bindings.h"
#include "math/adam.h"
#include "parallel.h"

namespace etsplat {
namespace {

constexpr int64_t kPiece = 16384;

struct AdamGroup {
    float* parameter;
    const float* gradient;
    float* first;
    float* second;
    int64_t size;
    float decay;  // times the parameter is added to its gradient
    AdamCoefficients<float> coefficients;
};

void adam_range(const AdamGroup& group, int64_t begin, int64_t end) {
    float* __restrict parameter = group.parameter;
    const float* __restrict gradient = group.gradient;
    float* __restrict first = group.first;
    float* __restrict second = group.second;
    const AdamCoefficients<float> coefficients = group.coefficients;
    const float decay = group.decay;
    if (decay == 0.0f) {
        for (int64_t i = begin; i < end; ++i)
            adam_update(parameter[i], first[i], second[i], gradient[i], coefficients);
    } else {
        for (int64_t i = begin; i < end; ++i)
            adam_update(parameter[i], first[i], second[i], gradient[i] + decay * parameter[i], coefficients);
    }
}

void adam_step(const std::vector<AdamGroup>& groups) {
    struct Piece {
        const AdamGroup* group;
        int64_t begin;
    };
    std::vector<Piece> pieces;
    for (const AdamGroup& group : groups) {
        for (int64_t begin = 0; begin < group.size; begin += kPiece) pieces.push_back({&group, begin});
    }
    parallel_for(static_cast<int64_t>(pieces.size()), 1, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) {
            const auto& [group, first] = pieces[i];
            adam_range(*group, first, std::min(first + kPiece, group->size));
        }
    });
}

}  // namespace

void bind_adam(nb::module_& m) {
    // One tensor of each kind, one rate and one decay per parameter; `step` counts from 1.
    def_function(
        m, "adam_step",
        [](const std::vector<Array<float>>& parameters, const std::vector<Array<const float>>& gradients,
           const std::vector<Array<float>>& firsts, const std::vector<Array<float>>& seconds,
           const std::vector<double>& learning_rates, const std::vector<double>& decays, double beta1, double beta2, double eps, int64_t step) {
            const double first_correction = 1.0 - std::pow(beta1, static_cast<double>(step));
            const double second_correction = std::sqrt(1.0 - std::pow(beta2, static_cast<double>(step)));
            std::vector<AdamGroup> groups;
            for (size_t i = 0; i < parameters.size(); ++i) {
                AdamCoefficients<float> k;
                k.first_weight = static_cast<float>(1.0 - beta1);
                k.second_decay = static_cast<float>(beta2);
                k.second_weight = static_cast<float>(1.0 - beta2);
                k.step_size = static_cast<float>(learning_rates.at(i) / first_correction);
                k.second_correction = static_cast<float>(second_correction);
                k.eps = static_cast<float>(eps);
                groups.push_back({parameters[i].data(), gradients.at(i).data(), firsts.at(i).data(),
                                  seconds.at(i).data(), parameters[i].count(), static_cast<float>(decays.at(i)), k});
            }
            adam_step(groups);
        },
        "parameters", "gradients", "firsts", "seconds", "learning_rates", "decays", "beta1", "beta2", "eps", "step");
}

}  // namespace etsplat
