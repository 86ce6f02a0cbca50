// Adam: all parameters of a step in one call, cut into pieces of about kPiece elements, whole rows of them, that threads
// take one by one; every element is independent.
#include <algorithm>
#include <cmath>
#include <vector>

#include "bindings.h"
#include "math/adam.h"
#include "parallel.h"

namespace etsplat {
namespace {

constexpr int64_t kPiece = 16384;
constexpr int64_t kTogether = 1024;  // elements whose paces are looked up before they are updated

struct AdamGroup {
    float* parameter;
    const float* gradient;
    float* first;
    float* second;
    const float* paces;  // of rows, or null
    int64_t size, width;  // elements, and those of a row
    float decay;  // times the parameter is added to its gradient
    AdamCoefficients<float> coefficients;

    // Elements of a piece: whole rows.
    int64_t piece() const { return paces ? std::max(width, kPiece / width * width) : kPiece; }
};

// Elements [begin, begin + count); size(i) is how far the i-th of these goes.
template <class Size>
void update(const AdamGroup& group, int64_t begin, int64_t count, const Size& size) {
    float* __restrict parameter = group.parameter + begin;
    const float* __restrict gradient = group.gradient + begin;
    float* __restrict first = group.first + begin;
    float* __restrict second = group.second + begin;
    AdamCoefficients<float> own = group.coefficients;
    const float decay = group.decay;
    for (int64_t i = 0; i < count; ++i) {
        own.step_size = size(i);
        adam_update(parameter[i], first[i], second[i], gradient[i], decay, own);
    }
}

// The same where rows have paces; `begin` is that of a row.
void update_paced(const AdamGroup& group, int64_t begin, int64_t end) {
    const float usual = group.coefficients.step_size;
    const float* pace = group.paces + begin / group.width;
    float sizes[kTogether];
    for (int64_t left = group.width; begin < end;) {  // of the row at hand
        const int64_t count = std::min(kTogether, end - begin);
        for (int64_t filled = 0; filled < count;) {
            const int64_t same = std::min(left, count - filled);
            std::fill_n(sizes + filled, same, usual * *pace);
            filled += same;
            left -= same;
            if (left == 0) {
                left = group.width;
                ++pace;
            }
        }
        update(group, begin, count, [&](int64_t i) { return sizes[i]; });
        begin += count;
    }
}

void adam_step(const std::vector<AdamGroup>& groups) {
    struct Piece {
        const AdamGroup* group;
        int64_t begin;
    };
    std::vector<Piece> pieces;
    for (const AdamGroup& group : groups) {
        for (int64_t begin = 0; begin < group.size; begin += group.piece()) pieces.push_back({&group, begin});
    }
    parallel_for(static_cast<int64_t>(pieces.size()), 1, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) {
            const auto& [group, first] = pieces[i];
            const int64_t last = std::min(first + group->piece(), group->size);
            if (group->paces) update_paced(*group, first, last);
            else update(*group, first, last - first, [&](int64_t) { return group->coefficients.step_size; });
        }
    });
}

}  // namespace

void bind_adam(nb::module_& m) {
    // One tensor of each kind, one rate and one decay per parameter, and its rows' paces or None; `step` counts from 1.
    def_function(
        m, "adam_step",
        [](const std::vector<Array<float>>& parameters, const std::vector<Array<const float>>& gradients,
           const std::vector<Array<float>>& firsts, const std::vector<Array<float>>& seconds,
           const std::vector<OptionalArray<const float, 1>>& paces, const std::vector<double>& learning_rates,
           const std::vector<double>& decays, double beta1, double beta2, double eps, int64_t step) {
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
                const int64_t size = parameters[i].count(), rows = paces.at(i) ? paces[i]->size(0) : 0;
                groups.push_back({parameters[i].data(), gradients.at(i).data(), firsts.at(i).data(), seconds.at(i).data(),
                                  data_or_null(paces[i]), size, rows ? size / rows : 1, static_cast<float>(decays.at(i)),
                                  k});
            }
            adam_step(groups);
        },
        "parameters", "gradients", "firsts", "seconds", "paces", "learning_rates", "decays", "beta1", "beta2", "eps",
        "step");
}

}  // namespace etsplat
