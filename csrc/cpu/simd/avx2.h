// AVX2 + FMA registers for pack.h: eight lanes in a register, masks in registers.
#pragma once

#include <immintrin.h>

namespace etsplat::avx2 {

constexpr int kRegisters = 2;
constexpr int kTogether = 1;
using Register = __m256;
using Mask = __m256;

ETSPLAT_FN Register r_set(float a) { return _mm256_set1_ps(a); }
ETSPLAT_FN Register r_load(const float* p) { return _mm256_loadu_ps(p); }
ETSPLAT_FN void r_store(float* p, Register a) { _mm256_storeu_ps(p, a); }
ETSPLAT_FN Register r_add(Register a, Register b) { return _mm256_add_ps(a, b); }
ETSPLAT_FN Register r_sub(Register a, Register b) { return _mm256_sub_ps(a, b); }
ETSPLAT_FN Register r_mul(Register a, Register b) { return _mm256_mul_ps(a, b); }
ETSPLAT_FN Register r_div(Register a, Register b) { return _mm256_div_ps(a, b); }
// 1 / a to about two units in the last place: an estimate of 12 bits and a Newton step cost less than a division.
ETSPLAT_FN Register r_reciprocal(Register a) {
    const Register estimate = _mm256_rcp_ps(a);
    return _mm256_fmadd_ps(estimate, _mm256_fnmadd_ps(a, estimate, _mm256_set1_ps(1.0f)), estimate);
}
ETSPLAT_FN Register r_fma(Register a, Register b, Register c) { return _mm256_fmadd_ps(a, b, c); }
ETSPLAT_FN Register r_min(Register a, Register b) { return _mm256_min_ps(a, b); }
ETSPLAT_FN Register r_max(Register a, Register b) { return _mm256_max_ps(a, b); }
ETSPLAT_FN Register r_sqrt(Register a) { return _mm256_sqrt_ps(a); }
ETSPLAT_FN Register r_floor(Register a) { return _mm256_round_ps(a, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC); }
ETSPLAT_FN Mask r_lt(Register a, Register b) { return _mm256_cmp_ps(a, b, _CMP_LT_OQ); }
ETSPLAT_FN Mask r_le(Register a, Register b) { return _mm256_cmp_ps(a, b, _CMP_LE_OQ); }
ETSPLAT_FN Register r_select(Mask m, Register a, Register b) { return _mm256_blendv_ps(b, a, m); }
ETSPLAT_FN Register r_keep(Mask m, Register a) { return _mm256_and_ps(m, a); }
ETSPLAT_FN Mask m_and(Mask a, Mask b) { return _mm256_and_ps(a, b); }
ETSPLAT_FN Mask m_or(Mask a, Mask b) { return _mm256_or_ps(a, b); }
ETSPLAT_FN Mask m_andnot(Mask a, Mask b) { return _mm256_andnot_ps(b, a); }
ETSPLAT_FN unsigned m_bits(Mask a) { return static_cast<unsigned>(_mm256_movemask_ps(a)); }
ETSPLAT_FN Mask m_from_bits(unsigned bits) {
    const __m256i lane_bit = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
    const __m256i set = _mm256_and_si256(_mm256_set1_epi32(static_cast<int>(bits)), lane_bit);
    return _mm256_castsi256_ps(_mm256_cmpeq_epi32(set, lane_bit));
}

ETSPLAT_FN void r_split(Register x, Register& mantissa, Register& exponent) {
    const __m256i bits = _mm256_castps_si256(x);
    const __m256i above = _mm256_sub_epi32(bits, _mm256_set1_epi32(0x3f400000));
    mantissa = _mm256_castsi256_ps(_mm256_sub_epi32(bits, _mm256_and_si256(above, _mm256_set1_epi32(-(1 << 23)))));
    exponent = _mm256_cvtepi32_ps(_mm256_srai_epi32(above, 23));
}
ETSPLAT_FN Register r_scale(Register a, Register shifted) {
    return _mm256_castsi256_ps(
        _mm256_add_epi32(_mm256_castps_si256(a), _mm256_slli_epi32(_mm256_castps_si256(shifted), 23)));
}

// Four floats in each half.
ETSPLAT_FN Register r_load_quads(const float* low, const float* high) {
    return _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(low)), _mm_loadu_ps(high), 1);
}
// In each half: columns[k] lane i = quads[i] lane k
ETSPLAT_FN void r_transpose_quads(const Register quads[4], Register columns[4]) {
    for (int half = 0; half < 2; ++half) {
        const Register a = half ? _mm256_unpackhi_ps(quads[0], quads[1]) : _mm256_unpacklo_ps(quads[0], quads[1]);
        const Register b = half ? _mm256_unpackhi_ps(quads[2], quads[3]) : _mm256_unpacklo_ps(quads[2], quads[3]);
        const __m256d low = _mm256_castps_pd(a), high = _mm256_castps_pd(b);
        columns[2 * half] = _mm256_castpd_ps(_mm256_unpacklo_pd(low, high));
        columns[2 * half + 1] = _mm256_castpd_ps(_mm256_unpackhi_pd(low, high));
    }
}

// out[k] lane i = table[index of lane i + k]
ETSPLAT_FN void r_lookup4(const float* table, Register index, Register out[4]) {
    alignas(32) int at[8];
    _mm256_store_si256(reinterpret_cast<__m256i*>(at), _mm256_cvttps_epi32(index));
    Register quads[4];
    for (int j = 0; j < 4; ++j) quads[j] = r_load_quads(table + at[j], table + at[4 + j]);
    r_transpose_quads(quads, out);
}

// Sums of the lanes of eight vectors, in order.
ETSPLAT_FN Register r_column_sums(const Register v[8]) {
    // quads hold, in each half, partial sums of four vectors
    const Register quad0 = _mm256_hadd_ps(_mm256_hadd_ps(v[0], v[1]), _mm256_hadd_ps(v[2], v[3]));
    const Register quad1 = _mm256_hadd_ps(_mm256_hadd_ps(v[4], v[5]), _mm256_hadd_ps(v[6], v[7]));
    return _mm256_add_ps(_mm256_permute2f128_ps(quad0, quad1, 0x20), _mm256_permute2f128_ps(quad0, quad1, 0x31));
}

// rows[i] lane j = columns[j] lane i
ETSPLAT_FN void r_transpose(const Register columns[8], Register rows[8]) {
    Register left[4], right[4];  // left[i], half p: lane 4 p + i of columns 0 .. 3; right: of the others
    r_transpose_quads(columns, left);
    r_transpose_quads(columns + 4, right);
    for (int i = 0; i < 4; ++i) {
        rows[i] = _mm256_permute2f128_ps(left[i], right[i], 0x20);
        rows[4 + i] = _mm256_permute2f128_ps(left[i], right[i], 0x31);
    }
}

// Eight lanes, the second four `apart` floats behind the first.
ETSPLAT_FN void r_load_apart(const float* in, int apart, Register& out) { out = r_load_quads(in, in + apart); }

// Eight pixels of three channels to one register per channel, and back. Each half has four pixels:
// a = x0 y0 z0 x1, b = y1 z1 x2 y2, c = z2 x3 y3 z3.
ETSPLAT_FN void r_deinterleave3(const float* in, Register out[3]) {
    const Register a = r_load_quads(in, in + 12), b = r_load_quads(in + 4, in + 16), c = r_load_quads(in + 8, in + 20);
    const Register first_yz = _mm256_shuffle_ps(a, b, _MM_SHUFFLE(1, 0, 2, 1));
    const Register last_xy = _mm256_shuffle_ps(b, c, _MM_SHUFFLE(2, 1, 3, 2));
    out[0] = _mm256_shuffle_ps(a, last_xy, _MM_SHUFFLE(2, 0, 3, 0));
    out[1] = _mm256_shuffle_ps(first_yz, last_xy, _MM_SHUFFLE(3, 1, 2, 0));
    out[2] = _mm256_shuffle_ps(first_yz, c, _MM_SHUFFLE(3, 0, 3, 1));
}
ETSPLAT_FN void r_interleave3(const Register in[3], float* out) {
    const Register even_xy = _mm256_shuffle_ps(in[0], in[1], _MM_SHUFFLE(2, 0, 2, 0));
    const Register odd_yz = _mm256_shuffle_ps(in[1], in[2], _MM_SHUFFLE(3, 1, 3, 1));
    const Register even_z_odd_x = _mm256_shuffle_ps(in[2], in[0], _MM_SHUFFLE(3, 1, 2, 0));
    const Register abc[3] = {_mm256_shuffle_ps(even_xy, even_z_odd_x, _MM_SHUFFLE(2, 0, 2, 0)),
                             _mm256_shuffle_ps(odd_yz, even_xy, _MM_SHUFFLE(3, 1, 2, 0)),
                             _mm256_shuffle_ps(even_z_odd_x, odd_yz, _MM_SHUFFLE(3, 1, 3, 1))};
    for (int k = 0; k < 3; ++k) {
        _mm_storeu_ps(out + 4 * k, _mm256_castps256_ps128(abc[k]));
        _mm_storeu_ps(out + 12 + 4 * k, _mm256_extractf128_ps(abc[k], 1));
    }
}

}  // namespace etsplat::avx2
