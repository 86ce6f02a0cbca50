// The kernels G(x) of the paper (section 3.2) with their derivatives and visible supports.
//
// x is the normalised distance: 0 at the triangle's centre, 1 on its edge. A kernel is a struct of functions, static ones
// where there is no table; ETSPLAT_KERNELS lists them once. What depends on sigma alone is computed once per triangle
// (KernelCoefficients), so that a pixel costs two exp2 and one log2 at most.
#pragma once

#include "portable.h"

namespace etsplat {

#define ETSPLAT_KERNELS(X) X(SingleSided) X(Bilateral) X(Elastic) X(Hard) X(Tabulated)
#define ETSPLAT_COUNT_ONE(K) +1
constexpr int kKernels = ETSPLAT_KERNELS(ETSPLAT_COUNT_ONE);
#undef ETSPLAT_COUNT_ONE

template <class T>
struct KernelCoefficients {
    T exponent;
    T scale;
};

template <class T>
struct KernelValue {
    T value;
    T dx;      // dG/dx
    T dsigma;  // dG/dsigma
};

// Floors that keep unbounded derivatives finite: dG/dx of the elastic kernel at x = 0 for sigma > 2, of the
// single-sided kernel at x = 1 for sigma < 1.
constexpr float kMinDistance = 1e-6f;
constexpr float kMinInnerDistance = 1e-4f;
constexpr float kMinSigma = 1e-6f;  // below, float cannot tell a kernel from a step; callers raise sigma to this

// x^(2/sigma) overflows for small sigma; G is 0 long before this power of two.
constexpr float kMaxLog2Power = 30.0f;

constexpr float kLog2E = 1.44269504088896f;
constexpr float kLn2 = 0.693147180559945f;

// G = max(1 - x, 0)^sigma
struct SingleSided {
    static constexpr bool kEndsAtOne = true;  // G(x) = 0 for x > 1
    template <class T>
    ETSPLAT_FN static KernelCoefficients<T> coefficients(T sigma) {
        return {sigma, T(0.0f)};
    }

    template <class T>
    ETSPLAT_FN static T value(T x, T sigma, T) {
        const T inner = T(1.0f) - x;
        return vselect(inner > T(0.0f), vexp2(sigma * vlog2(vmax(inner, T(1e-20f)))), T(0.0f));
    }

    template <class T>
    ETSPLAT_FN static KernelValue<T> gradient(T x, T sigma, T) {
        const T inner = T(1.0f) - x;
        const T floored = vmax(inner, T(kMinInnerDistance));
        const T log_floored = vlog2(floored);
        const T inside = vselect(inner > T(0.0f), T(1.0f), T(0.0f));
        KernelValue<T> g;
        g.value = value(x, sigma, sigma);
        g.dx = T(0.0f) - inside * sigma * vexp2((sigma - T(1.0f)) * log_floored);
        g.dsigma = g.value * log_floored * T(kLn2);
        return g;
    }

    // Largest x with o G(x) >= alpha_min; `ratio` = o / alpha_min > 1.
    template <class T>
    ETSPLAT_FN static T support(T ratio, T sigma) {
        return T(1.0f) - vexp2(T(0.0f) - vlog2(ratio) / sigma);
    }
};

// G = exp(-x^(2/sigma) / 2)
struct Bilateral {
    static constexpr bool kEndsAtOne = false;
    template <class T>
    ETSPLAT_FN static KernelCoefficients<T> coefficients(T sigma) {
        return {T(2.0f) / sigma, T(-0.5f * kLog2E)};
    }

    template <class T>
    ETSPLAT_FN static T value(T x, T exponent, T scale) {
        return vexp2(scale * vexp2(vmin(exponent * vlog2(vmax(x, T(kMinDistance))), T(kMaxLog2Power))));
    }

    template <class T>
    ETSPLAT_FN static KernelValue<T> gradient(T x, T exponent, T scale) {
        const T floored = vmax(x, T(kMinDistance));
        const T log_x = vlog2(floored);
        const T power = vexp2(vmin(exponent * log_x, T(kMaxLog2Power)));
        KernelValue<T> g;
        g.value = vexp2(scale * power);
        const T decay = g.value * power;
        g.dx = T(-0.5f) * exponent * decay * vreciprocal(floored);
        g.dsigma = decay * log_x * (exponent * exponent) * T(0.25f * kLn2);
        return g;
    }

    template <class T>
    ETSPLAT_FN static T support(T ratio, T sigma) {
        return vexp2(vmin(T(0.5f) * sigma * vlog2(T(2.0f * kLn2) * vlog2(ratio)), T(kMaxLog2Power)));
    }
};

// G = exp(-sigma x^(2/sigma))
struct Elastic {
    static constexpr bool kEndsAtOne = false;
    template <class T>
    ETSPLAT_FN static KernelCoefficients<T> coefficients(T sigma) {
        return {T(2.0f) / sigma, sigma * T(-kLog2E)};
    }

    template <class T>
    ETSPLAT_FN static T value(T x, T exponent, T scale) {
        return Bilateral::value(x, exponent, scale);
    }

    template <class T>
    ETSPLAT_FN static KernelValue<T> gradient(T x, T exponent, T scale) {
        const T floored = vmax(x, T(kMinDistance));
        const T log_x = vlog2(floored);
        const T power = vexp2(vmin(exponent * log_x, T(kMaxLog2Power)));
        KernelValue<T> g;
        g.value = vexp2(scale * power);
        const T decay = g.value * power;
        g.dx = T(-2.0f) * decay * vreciprocal(floored);
        g.dsigma = decay * vfma(exponent * T(kLn2), log_x, T(-1.0f));
        return g;
    }

    template <class T>
    ETSPLAT_FN static T support(T ratio, T sigma) {
        const T power = vmax(T(kLn2) * vlog2(ratio) / sigma, T(1e-30f));  // x^(2/sigma), a normal number
        return vexp2(vmin(T(0.5f) * sigma * vlog2(power), T(kMaxLog2Power)));
    }
};

// G = 1 inside, 0 outside
struct Hard {
    static constexpr bool kEndsAtOne = true;
    template <class T>
    ETSPLAT_FN static KernelCoefficients<T> coefficients(T) {
        return {T(0.0f), T(0.0f)};
    }

    template <class T>
    ETSPLAT_FN static T value(T x, T, T) {
        return vselect(x <= T(1.0f), T(1.0f), T(0.0f));
    }

    template <class T>
    ETSPLAT_FN static KernelValue<T> gradient(T x, T exponent, T scale) {
        return {value(x, exponent, scale), T(0.0f), T(0.0f)};
    }

    template <class T>
    ETSPLAT_FN static T support(T, T) {
        return T(1.0f);
    }
};

}  // namespace etsplat

#include "kernel_table.h"

namespace etsplat {

// A kernel that reads `table`, or one that needs none.
template <class Kernel>
ETSPLAT_FN Kernel kernel_with(const float* table) {
    if constexpr (__is_empty(Kernel))
        return Kernel{};
    else
        return Kernel{table};
}

constexpr float kSupportMargin = 1.0f + 1e-4f;  // the alpha test decides; the extent only bounds the work
constexpr float kLargestExtent = 1e6f;

// Largest visible x of a triangle, or a negative number if nothing is visible. alpha_min = 0: there is no such test.
template <class Kernel, class T>
ETSPLAT_FN T visible_extent(const Kernel& kernel, T opacity, T sigma, float alpha_min, float x_max) {
    T extent(vmin(x_max, kLargestExtent));
    if (alpha_min > 0.0f) {
        const T ratio = opacity / T(alpha_min);
        const T support = kernel.support(vmin(vmax(ratio, T(1.0f + 1e-6f)), T(1e30f)), vmax(sigma, T(kMinSigma)));
        extent = vmin(extent, support * T(kSupportMargin) + T(1e-5f));
        extent = vselect(ratio >= T(1.0f), extent, T(-1.0f));
    } else if (Kernel::kEndsAtOne) {
        extent = vmin(extent, T(1.0f));
    }
    return extent;
}

}  // namespace etsplat
