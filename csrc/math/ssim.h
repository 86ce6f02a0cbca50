// Structural similarity (Wang et al. 2004) of one value: window, formula and derivatives.
#pragma once

#include "portable.h"

namespace etsplat {

constexpr int kSsimReach = 5, kSsimTaps = 2 * kSsimReach + 1;
constexpr float kSsimC1 = 0.01f * 0.01f, kSsimC2 = 0.03f * 0.03f;

// exp(-k^2 / (2 1.5^2)) for k = 0..5, divided by the sum over -5..5. `at(k)` is the value k places further.
template <class At>
ETSPLAT_FN float ssim_blur(const At& at) {
    constexpr float window[kSsimReach + 1] = {0.26601172486179436f, 0.2130055377112537f,   0.10936068950970002f,
                                              0.03600077212843083f, 0.007598758135239185f, 0.00102838008447911f};
    float sum = window[0] * at(0);
    for (int k = 1; k <= kSsimReach; ++k) sum += window[k] * (at(-k) + at(k));
    return sum;
}

// SSIM = (2 mx my + C1) (2 cov + C2) / ((mx^2 + my^2 + C1) (var x + var y + C2)) from the moments mx = E x, my = E y,
// square = E (x^2 + y^2), product = E x y; and its derivatives by mx, by E x^2 and by E x y.
struct Similarity {
    float value, by_mean, by_square, by_product;
};

ETSPLAT_FN Similarity similarity(float mx, float my, float square, float product) {
    const float cross = mx * my, squares = mx * mx + my * my;
    const float a1 = 2.0f * cross + kSsimC1, a2 = 2.0f * (product - cross) + kSsimC2;
    const float b1 = squares + kSsimC1, b2 = square - squares + kSsimC2;
    const float inverse = 1.0f / (b1 * b2), s = a1 * a2 * inverse;
    const float over_b2 = s * b1 * inverse, over_b1 = s * b2 * inverse;  // s / b2, s / b1
    return {s, 2.0f * (my * (a2 - a1) * inverse + mx * (over_b2 - over_b1)), -over_b2, 2.0f * a1 * inverse};
}

// Derivative of the sum of similarities by x at a place where the three derivative maps, blurred, have these values.
ETSPLAT_FN float similarity_slope(float by_mean, float by_square, float by_product, float x, float y) {
    return by_mean + 2.0f * x * by_square + y * by_product;
}

}  // namespace etsplat
