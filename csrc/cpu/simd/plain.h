// Registers for pack.h that need no instruction set: four lanes by the vector extensions of GCC and Clang, which make
// of them what every processor of the target has (SSE2 on x86-64), and one lane elsewhere.
#pragma once

#include <bit>
#include <cmath>
#include <cstdint>

namespace etsplat::plain {

constexpr int kTogether = 1;

#if defined(__GNUC__) || defined(__clang__)

constexpr int kRegisters = 4;
typedef float Register __attribute__((vector_size(16)));
typedef int32_t Mask __attribute__((vector_size(16)));  // all bits or none; also whole numbers

ETSPLAT_FN Register r_set(float a) { return Register{a, a, a, a}; }
ETSPLAT_FN Register r_load(const float* p) { return Register{p[0], p[1], p[2], p[3]}; }
ETSPLAT_FN void r_store(float* p, Register a) {
    for (int i = 0; i < 4; ++i) p[i] = a[i];
}
ETSPLAT_FN Mask r_lt(Register a, Register b) { return a < b; }
ETSPLAT_FN Mask r_le(Register a, Register b) { return a <= b; }
ETSPLAT_FN Mask whole(Register a) { return __builtin_convertvector(a, Mask); }  // towards zero
ETSPLAT_FN Register real(Mask a) { return __builtin_convertvector(a, Register); }
ETSPLAT_FN Register r_sqrt(Register a) {
    for (int i = 0; i < 4; ++i) a[i] = std::sqrt(a[i]);
    return a;
}
ETSPLAT_FN unsigned m_bits(Mask a) {
    const Mask set = a & Mask{1, 2, 4, 8};
    return static_cast<unsigned>((set[0] | set[1]) | (set[2] | set[3]));
}
ETSPLAT_FN Mask m_from_bits(unsigned bits) {
    const int32_t b = static_cast<int32_t>(bits);
    return (Mask{b, b, b, b} & Mask{1, 2, 4, 8}) != Mask{};
}

// out[k] lane i = table[index of lane i + k]
ETSPLAT_FN void r_lookup4(const float* table, Register index, Register out[4]) {
    const Mask at = whole(index);
    for (int k = 0; k < 4; ++k) out[k] = Register{table[at[0] + k], table[at[1] + k], table[at[2] + k], table[at[3] + k]};
}

// Sums of the lanes of four vectors, in order.
ETSPLAT_FN Register r_column_sums(const Register v[4]) {
    const Register a = v[0], b = v[1], c = v[2], d = v[3];
    return (Register{a[0], b[0], c[0], d[0]} + Register{a[1], b[1], c[1], d[1]}) +
           (Register{a[2], b[2], c[2], d[2]} + Register{a[3], b[3], c[3], d[3]});
}

#else

constexpr int kRegisters = 16;
using Register = float;
using Mask = int32_t;

ETSPLAT_FN Register r_set(float a) { return a; }
ETSPLAT_FN Register r_load(const float* p) { return *p; }
ETSPLAT_FN void r_store(float* p, Register a) { *p = a; }
ETSPLAT_FN Mask r_lt(Register a, Register b) { return a < b ? -1 : 0; }
ETSPLAT_FN Mask r_le(Register a, Register b) { return a <= b ? -1 : 0; }
ETSPLAT_FN Mask whole(Register a) { return static_cast<Mask>(a); }
ETSPLAT_FN Register real(Mask a) { return static_cast<Register>(a); }
ETSPLAT_FN Register r_sqrt(Register a) { return std::sqrt(a); }
ETSPLAT_FN unsigned m_bits(Mask a) { return a & 1; }
ETSPLAT_FN Mask m_from_bits(unsigned bits) { return -static_cast<Mask>(bits & 1u); }
ETSPLAT_FN void r_lookup4(const float* table, Register index, Register out[4]) {
    for (int k = 0; k < 4; ++k) out[k] = table[static_cast<int>(index) + k];
}
ETSPLAT_FN Register r_column_sums(const Register* v) { return *v; }

#endif

ETSPLAT_FN Mask to_bits(Register a) { return std::bit_cast<Mask>(a); }
ETSPLAT_FN Register from_bits(Mask a) { return std::bit_cast<Register>(a); }

ETSPLAT_FN Register r_add(Register a, Register b) { return a + b; }
ETSPLAT_FN Register r_sub(Register a, Register b) { return a - b; }
ETSPLAT_FN Register r_mul(Register a, Register b) { return a * b; }
ETSPLAT_FN Register r_div(Register a, Register b) { return a / b; }
ETSPLAT_FN Register r_reciprocal(Register a) { return r_set(1.0f) / a; }
ETSPLAT_FN Register r_fma(Register a, Register b, Register c) { return a * b + c; }
ETSPLAT_FN Register r_min(Register a, Register b) { return a < b ? a : b; }
ETSPLAT_FN Register r_max(Register a, Register b) { return a > b ? a : b; }
ETSPLAT_FN Mask m_and(Mask a, Mask b) { return a & b; }
ETSPLAT_FN Mask m_or(Mask a, Mask b) { return a | b; }
ETSPLAT_FN Mask m_andnot(Mask a, Mask b) { return a & ~b; }
ETSPLAT_FN Register r_keep(Mask m, Register a) { return from_bits(m & to_bits(a)); }
ETSPLAT_FN Register r_select(Mask m, Register a, Register b) { return from_bits((m & to_bits(a)) | (~m & to_bits(b))); }

// For |a| < 2^31, without a library call, which rounding is on x86 without SSE4.1.
ETSPLAT_FN Register r_floor(Register a) {
    const Register towards_zero = real(whole(a));
    return towards_zero - r_keep(r_lt(a, towards_zero), r_set(1.0f));
}

ETSPLAT_FN void r_split(Register x, Register& mantissa, Register& exponent) {
    const Mask bits = to_bits(x), above = bits - 0x3f400000;
    mantissa = from_bits(bits - (above & -(1 << 23)));
    exponent = real(above >> 23);
}
ETSPLAT_FN Register r_scale(Register a, Register shifted) { return from_bits(to_bits(a) + (to_bits(shifted) << 23)); }

}  // namespace etsplat::plain
