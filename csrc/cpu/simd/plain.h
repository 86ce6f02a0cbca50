// Plain C++ "registers" for pack.h: one lane each. The compiler vectorises what it can.
#pragma once

#include <bit>
#include <cmath>
#include <cstdint>

namespace etsplat::plain {

constexpr int kRegisters = 16;
using Register = float;
using Mask = uint32_t;  // all bits or none

ETSPLAT_FN Register r_set(float a) { return a; }
ETSPLAT_FN Register r_load(const float* p) { return *p; }
ETSPLAT_FN void r_store(float* p, Register a) { *p = a; }
ETSPLAT_FN Register r_add(Register a, Register b) { return a + b; }
ETSPLAT_FN Register r_sub(Register a, Register b) { return a - b; }
ETSPLAT_FN Register r_mul(Register a, Register b) { return a * b; }
ETSPLAT_FN Register r_div(Register a, Register b) { return a / b; }
ETSPLAT_FN Register r_reciprocal(Register a) { return 1.0f / a; }
ETSPLAT_FN Register r_fma(Register a, Register b, Register c) { return a * b + c; }
ETSPLAT_FN Register r_min(Register a, Register b) { return a < b ? a : b; }
ETSPLAT_FN Register r_max(Register a, Register b) { return a > b ? a : b; }
ETSPLAT_FN Register r_sqrt(Register a) { return std::sqrt(a); }
ETSPLAT_FN Register r_floor(Register a) { return std::floor(a); }
// For |a| < 2^22; without the library call that std::nearbyint is on x86 without SSE4.1.
ETSPLAT_FN Register r_round(Register a) { return (a + 12582912.0f) - 12582912.0f; }
ETSPLAT_FN Mask r_lt(Register a, Register b) { return a < b ? ~0u : 0u; }
ETSPLAT_FN Mask r_le(Register a, Register b) { return a <= b ? ~0u : 0u; }
ETSPLAT_FN Register r_select(Mask m, Register a, Register b) {
    return std::bit_cast<float>((std::bit_cast<uint32_t>(a) & m) | (std::bit_cast<uint32_t>(b) & ~m));
}
ETSPLAT_FN Register r_keep(Mask m, Register a) { return std::bit_cast<float>(std::bit_cast<uint32_t>(a) & m); }
ETSPLAT_FN Mask m_and(Mask a, Mask b) { return a & b; }
ETSPLAT_FN Mask m_or(Mask a, Mask b) { return a | b; }
ETSPLAT_FN Mask m_andnot(Mask a, Mask b) { return a & ~b; }
ETSPLAT_FN unsigned m_bits(Mask a) { return a & 1u; }
ETSPLAT_FN Mask m_from_bits(unsigned bits) { return 0u - (bits & 1u); }

ETSPLAT_FN void r_split(Register x, Register& mantissa, Register& exponent) {
    const int32_t bits = std::bit_cast<int32_t>(x);
    const int32_t e = (bits - 0x3f400000) >> 23;
    mantissa = std::bit_cast<float>(bits - (e << 23));
    exponent = static_cast<float>(e);
}
ETSPLAT_FN Register r_scale(Register a, Register n) {
    return std::bit_cast<float>(std::bit_cast<int32_t>(a) + (static_cast<int32_t>(n) << 23));
}

// out[k] = table[index + k]
ETSPLAT_FN void r_lookup4(const float* table, Register index, Register out[4]) {
    for (int k = 0; k < 4; ++k) out[k] = table[static_cast<int>(index) + k];
}

ETSPLAT_FN Register r_column_sums(const Register* v) { return *v; }

}  // namespace etsplat::plain
