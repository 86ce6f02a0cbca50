// What the shared formulas in csrc/math need from the compiler and the number type.
//
// The formulas are templates over T. The CPU engine instantiates them with 16-lane vectors (csrc/cpu/simd), scalar code
// with float, the GPU engine with float. A number type brings the operators + - * / and the functions below; comparisons
// give its mask type, with the operators & and |. In vectors there is no early return: functions compute all lanes and
// return a mask of those that count.
#pragma once

#if defined(__CUDACC__) || defined(__CUDACC_RTC__)
#define ETSPLAT_FN __device__ __forceinline__
#define ETSPLAT_CONSTEXPR_FN __device__ constexpr
#elif defined(_MSC_VER)
#define ETSPLAT_FN __forceinline
#include <cmath>
#elif defined(ETSPLAT_SANITIZE)  // instrumented code inlined this far takes minutes to compile
#define ETSPLAT_FN inline
#include <cmath>
#else
#define ETSPLAT_FN inline __attribute__((always_inline))
#include <cmath>
#endif
#ifndef ETSPLAT_CONSTEXPR_FN
#define ETSPLAT_CONSTEXPR_FN constexpr
#endif

namespace etsplat {

ETSPLAT_FN float vmin(float a, float b) { return a < b ? a : b; }
ETSPLAT_FN float vmax(float a, float b) { return a > b ? a : b; }
ETSPLAT_FN float vselect(bool mask, float a, float b) { return mask ? a : b; }
ETSPLAT_FN bool vany(bool mask) { return mask; }
// Floats of a table at an index, which is a whole number.
ETSPLAT_FN float vlookup(const float* table, float index) { return table[static_cast<int>(index)]; }
ETSPLAT_FN void vlookup4(const float* table, float index, float* out) {
    for (int k = 0; k < 4; ++k) out[k] = table[static_cast<int>(index) + k];
}

// a b, rounded before anything is added to it, also where contraction is on.
#if defined(__CUDACC__) || defined(__CUDACC_RTC__)
ETSPLAT_FN float vproduct(float a, float b) { return __fmul_rn(a, b); }
ETSPLAT_FN double vproduct(double a, double b) { return __dmul_rn(a, b); }
#else
template <class T>
ETSPLAT_FN T vproduct(T a, T b) {
    return a * b;
}
#endif

// What a comparison of two T gives.
template <class T>
using MaskOf = decltype(T() < T());

#if defined(__CUDACC__) || defined(__CUDACC_RTC__)
ETSPLAT_FN float vfma(float a, float b, float c) { return fmaf(a, b, c); }
ETSPLAT_FN float vreciprocal(float a) { return __fdividef(1.0f, a); }  // to 2 ulp, up to 2^126; one instruction where ftz
ETSPLAT_FN float vlog2(float a) { return __log2f(a); }
ETSPLAT_FN float vexp2(float a) { return exp2f(a); }
ETSPLAT_FN float vsqrt(float a) { return sqrtf(a); }
ETSPLAT_FN float vfloor(float a) { return floorf(a); }
ETSPLAT_FN float vabs(float a) { return fabsf(a); }
ETSPLAT_FN int float_bits(float a) { return __float_as_int(a); }
ETSPLAT_FN float bits_float(int a) { return __int_as_float(a); }
#else
ETSPLAT_FN float vfma(float a, float b, float c) { return a * b + c; }
ETSPLAT_FN float vreciprocal(float a) { return 1.0f / a; }
ETSPLAT_FN float vlog2(float a) { return std::log2(a); }
ETSPLAT_FN float vexp2(float a) { return std::exp2(a); }
ETSPLAT_FN float vsqrt(float a) { return std::sqrt(a); }
ETSPLAT_FN float vfloor(float a) { return std::floor(a); }
ETSPLAT_FN float vabs(float a) { return std::fabs(a); }
ETSPLAT_FN int float_bits(float a) { return __builtin_bit_cast(int, a); }
ETSPLAT_FN float bits_float(int a) { return __builtin_bit_cast(float, a); }
#endif

// x = mantissa 2^exponent with mantissa in [3/4, 3/2), for a positive normal number
ETSPLAT_FN void vsplit(float x, float& mantissa, float& exponent) {
    const int bits = float_bits(x), e = (bits - 0x3f400000) >> 23;
    mantissa = bits_float(bits - e * (1 << 23));
    exponent = static_cast<float>(e);
}
// a 2^n for a whole number n; a and the result are normal numbers
ETSPLAT_FN float vscale(float a, float n) { return bits_float(float_bits(a) + static_cast<int>(n) * (1 << 23)); }

}  // namespace etsplat
