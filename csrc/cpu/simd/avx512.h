// AVX-512 registers for pack.h: sixteen lanes in one register, masks in mask registers.
#pragma once

#include <immintrin.h>

namespace etsplat::avx512 {

constexpr int kRegisters = 1;
constexpr int kTogether = 3;  // one chain of operations leaves half of the processor idle
using Register = __m512;
using Mask = __mmask16;

ETSPLAT_FN Register r_set(float a) { return _mm512_set1_ps(a); }
ETSPLAT_FN Register r_load(const float* p) { return _mm512_loadu_ps(p); }
ETSPLAT_FN void r_store(float* p, Register a) { _mm512_storeu_ps(p, a); }
ETSPLAT_FN Register r_add(Register a, Register b) { return _mm512_add_ps(a, b); }
ETSPLAT_FN Register r_sub(Register a, Register b) { return _mm512_sub_ps(a, b); }
ETSPLAT_FN Register r_mul(Register a, Register b) { return _mm512_mul_ps(a, b); }
ETSPLAT_FN Register r_div(Register a, Register b) { return _mm512_div_ps(a, b); }
// 1 / a to about one unit in the last place: an estimate of 14 bits and a Newton step cost a third of a division.
ETSPLAT_FN Register r_reciprocal(Register a) {
    const Register estimate = _mm512_rcp14_ps(a);
    return _mm512_fmadd_ps(estimate, _mm512_fnmadd_ps(a, estimate, _mm512_set1_ps(1.0f)), estimate);
}
ETSPLAT_FN Register r_fma(Register a, Register b, Register c) { return _mm512_fmadd_ps(a, b, c); }
ETSPLAT_FN Register r_min(Register a, Register b) { return _mm512_min_ps(a, b); }
ETSPLAT_FN Register r_max(Register a, Register b) { return _mm512_max_ps(a, b); }
ETSPLAT_FN Register r_sqrt(Register a) { return _mm512_sqrt_ps(a); }
ETSPLAT_FN Register r_floor(Register a) { return _mm512_roundscale_ps(a, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC); }
ETSPLAT_FN Mask r_lt(Register a, Register b) { return _mm512_cmp_ps_mask(a, b, _CMP_LT_OQ); }
ETSPLAT_FN Mask r_le(Register a, Register b) { return _mm512_cmp_ps_mask(a, b, _CMP_LE_OQ); }
ETSPLAT_FN Register r_select(Mask m, Register a, Register b) { return _mm512_mask_blend_ps(m, b, a); }
ETSPLAT_FN Register r_keep(Mask m, Register a) { return _mm512_maskz_mov_ps(m, a); }
ETSPLAT_FN Mask m_and(Mask a, Mask b) { return static_cast<Mask>(a & b); }
ETSPLAT_FN Mask m_or(Mask a, Mask b) { return static_cast<Mask>(a | b); }
ETSPLAT_FN Mask m_andnot(Mask a, Mask b) { return static_cast<Mask>(a & ~b); }
ETSPLAT_FN unsigned m_bits(Mask a) { return a; }
ETSPLAT_FN Mask m_from_bits(unsigned bits) { return static_cast<Mask>(bits); }

// x = mantissa 2^exponent with mantissa in [3/4, 3/2). On integers, for the sake of latency: three cycles to the mantissa.
ETSPLAT_FN void r_split(Register x, Register& mantissa, Register& exponent) {
    const __m512i bits = _mm512_castps_si512(x);
    const __m512i above = _mm512_sub_epi32(bits, _mm512_set1_epi32(0x3f400000));
    mantissa = _mm512_castsi512_ps(_mm512_sub_epi32(bits, _mm512_and_si512(above, _mm512_set1_epi32(-(1 << 23)))));
    exponent = _mm512_cvtepi32_ps(_mm512_srai_epi32(above, 23));
}
ETSPLAT_FN Register r_scale(Register a, Register shifted) {
    return _mm512_castsi512_ps(
        _mm512_add_epi32(_mm512_castps_si512(a), _mm512_slli_epi32(_mm512_castps_si512(shifted), 23)));
}

// out[k] lane i = table[index of lane i + k]: sixteen loads of four floats and a transposition, which take less time than
// four gathers.
ETSPLAT_FN void r_lookup4(const float* table, Register index, Register out[4]) {
    alignas(64) int at[16];
    _mm512_store_si512(at, _mm512_cvttps_epi32(index));
    Register quads[4];  // quads[j], 128-bit part p: of lane 4 p + j
    for (int j = 0; j < 4; ++j) {
        Register quad = _mm512_castps128_ps512(_mm_loadu_ps(table + at[j]));
        quad = _mm512_insertf32x4(quad, _mm_loadu_ps(table + at[4 + j]), 1);
        quad = _mm512_insertf32x4(quad, _mm_loadu_ps(table + at[8 + j]), 2);
        quads[j] = _mm512_insertf32x4(quad, _mm_loadu_ps(table + at[12 + j]), 3);
    }
    for (int half = 0; half < 2; ++half) {
        const Register a = half ? _mm512_unpackhi_ps(quads[0], quads[1]) : _mm512_unpacklo_ps(quads[0], quads[1]);
        const Register b = half ? _mm512_unpackhi_ps(quads[2], quads[3]) : _mm512_unpacklo_ps(quads[2], quads[3]);
        const __m512d low = _mm512_castps_pd(a), high = _mm512_castps_pd(b);
        out[2 * half] = _mm512_castpd_ps(_mm512_unpacklo_pd(low, high));
        out[2 * half + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(low, high));
    }
}

// Sums of the lanes of sixteen vectors, in order.
ETSPLAT_FN Register r_column_sums(const Register v[16]) {
    Register pairs[8], quads[4], halves[2];
    for (int i = 0; i < 8; ++i)
        pairs[i] = _mm512_add_ps(_mm512_unpacklo_ps(v[2 * i], v[2 * i + 1]), _mm512_unpackhi_ps(v[2 * i], v[2 * i + 1]));
    for (int i = 0; i < 4; ++i) {
        const __m512d a = _mm512_castps_pd(pairs[2 * i]), b = _mm512_castps_pd(pairs[2 * i + 1]);
        quads[i] = _mm512_add_ps(_mm512_castpd_ps(_mm512_unpacklo_pd(a, b)), _mm512_castpd_ps(_mm512_unpackhi_pd(a, b)));
    }
    // quads[i] holds, in each 128-bit part, partial sums of vectors 4i .. 4i+3.
    for (int i = 0; i < 2; ++i) {
        const Register a = quads[2 * i], b = quads[2 * i + 1];
        halves[i] = _mm512_add_ps(_mm512_shuffle_f32x4(a, b, 0x88), _mm512_shuffle_f32x4(a, b, 0xdd));
    }
    return _mm512_add_ps(_mm512_shuffle_f32x4(halves[0], halves[1], 0x88),
                         _mm512_shuffle_f32x4(halves[0], halves[1], 0xdd));
}

// rows[i] lane j = columns[j] lane i
ETSPLAT_FN void r_transpose(const Register columns[16], Register rows[16]) {
    Register quads[16];  // quads[4 i + j], 128-bit part p: lane 4 p + j of columns 4 i .. 4 i + 3
    for (int i = 0; i < 4; ++i)
        for (int half = 0; half < 2; ++half) {
            const Register* c = columns + 4 * i;
            const Register a = half ? _mm512_unpackhi_ps(c[0], c[1]) : _mm512_unpacklo_ps(c[0], c[1]);
            const Register b = half ? _mm512_unpackhi_ps(c[2], c[3]) : _mm512_unpacklo_ps(c[2], c[3]);
            const __m512d low = _mm512_castps_pd(a), high = _mm512_castps_pd(b);
            quads[4 * i + 2 * half] = _mm512_castpd_ps(_mm512_unpacklo_pd(low, high));
            quads[4 * i + 2 * half + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(low, high));
        }
    for (int j = 0; j < 4; ++j) {
        const Register even_low = _mm512_shuffle_f32x4(quads[j], quads[4 + j], 0x88);
        const Register even_high = _mm512_shuffle_f32x4(quads[8 + j], quads[12 + j], 0x88);
        const Register odd_low = _mm512_shuffle_f32x4(quads[j], quads[4 + j], 0xdd);
        const Register odd_high = _mm512_shuffle_f32x4(quads[8 + j], quads[12 + j], 0xdd);
        rows[j] = _mm512_shuffle_f32x4(even_low, even_high, 0x88);
        rows[4 + j] = _mm512_shuffle_f32x4(odd_low, odd_high, 0x88);
        rows[8 + j] = _mm512_shuffle_f32x4(even_low, even_high, 0xdd);
        rows[12 + j] = _mm512_shuffle_f32x4(odd_low, odd_high, 0xdd);
    }
}

// Sixteen lanes, each four `apart` floats behind those before.
ETSPLAT_FN void r_load_apart(const float* in, int apart, Register& out) {
    out = _mm512_castps128_ps512(_mm_loadu_ps(in));
    out = _mm512_insertf32x4(out, _mm_loadu_ps(in + apart), 1);
    out = _mm512_insertf32x4(out, _mm_loadu_ps(in + 2 * apart), 2);
    out = _mm512_insertf32x4(out, _mm_loadu_ps(in + 3 * apart), 3);
}

// Sixteen pixels of three channels to one register per channel, and back.
ETSPLAT_FN void r_deinterleave3(const float* in, Register out[3]) {
    const Register a = _mm512_loadu_ps(in), b = _mm512_loadu_ps(in + 16), c = _mm512_loadu_ps(in + 32);
    alignas(64) static constexpr int kFromAB[3][16] = {{0, 3, 6, 9, 12, 15, 18, 21, 24, 27, 30, 0, 0, 0, 0, 0},
                                                       {1, 4, 7, 10, 13, 16, 19, 22, 25, 28, 31, 0, 0, 0, 0, 0},
                                                       {2, 5, 8, 11, 14, 17, 20, 23, 26, 29, 0, 0, 0, 0, 0, 0}};
    alignas(64) static constexpr int kWithC[3][16] = {{0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 17, 20, 23, 26, 29},
                                                      {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 18, 21, 24, 27, 30},
                                                      {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 16, 19, 22, 25, 28, 31}};
    for (int k = 0; k < 3; ++k) {
        const Register ab = _mm512_permutex2var_ps(a, _mm512_load_si512(kFromAB[k]), b);
        out[k] = _mm512_permutex2var_ps(ab, _mm512_load_si512(kWithC[k]), c);
    }
}
ETSPLAT_FN void r_interleave3(const Register in[3], float* out) {
    alignas(64) static constexpr int kFromAB[3][16] = {{0, 16, 0, 1, 17, 0, 2, 18, 0, 3, 19, 0, 4, 20, 0, 5},
                                                       {21, 0, 6, 22, 0, 7, 23, 0, 8, 24, 0, 9, 25, 0, 10, 26},
                                                       {0, 11, 27, 0, 12, 28, 0, 13, 29, 0, 14, 30, 0, 15, 31, 0}};
    alignas(64) static constexpr int kWithC[3][16] = {{0, 1, 16, 3, 4, 17, 6, 7, 18, 9, 10, 19, 12, 13, 20, 15},
                                                      {0, 21, 2, 3, 22, 5, 6, 23, 8, 9, 24, 11, 12, 25, 14, 15},
                                                      {26, 1, 2, 27, 4, 5, 28, 7, 8, 29, 10, 11, 30, 13, 14, 31}};
    for (int k = 0; k < 3; ++k) {
        const Register ab = _mm512_permutex2var_ps(in[0], _mm512_load_si512(kFromAB[k]), in[1]);
        _mm512_storeu_ps(out + 16 * k, _mm512_permutex2var_ps(ab, _mm512_load_si512(kWithC[k]), in[2]));
    }
}

}  // namespace etsplat::avx512
