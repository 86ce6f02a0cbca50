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
ETSPLAT_FN float vabs(float a) { return a < 0.0f ? -a : a; }
ETSPLAT_FN float vreciprocal(float a) { return 1.0f / a; }
ETSPLAT_FN float vselect(bool mask, float a, float b) { return mask ? a : b; }

// What a comparison of two T gives.
template <class T>
using MaskOf = decltype(T() < T());

#if defined(__CUDACC__) || defined(__CUDACC_RTC__)
ETSPLAT_FN float vfma(float a, float b, float c) { return fmaf(a, b, c); }
ETSPLAT_FN float vlog2(float a) { return __log2f(a); }
ETSPLAT_FN float vexp2(float a) { return exp2f(a); }
ETSPLAT_FN float vsqrt(float a) { return sqrtf(a); }
ETSPLAT_FN float vfloor(float a) { return floorf(a); }
#else
ETSPLAT_FN float vfma(float a, float b, float c) { return a * b + c; }
ETSPLAT_FN float vlog2(float a) { return std::log2(a); }
ETSPLAT_FN float vexp2(float a) { return std::exp2(a); }
ETSPLAT_FN float vsqrt(float a) { return std::sqrt(a); }
ETSPLAT_FN float vfloor(float a) { return std::floor(a); }
#endif

}  // namespace etsplat
