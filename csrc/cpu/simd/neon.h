// AArch64 NEON registers for pack.h: four lanes in a register, masks in integer registers.
#pragma once

#include <arm_neon.h>

namespace etsplat::neon {

constexpr int kRegisters = 4;
constexpr int kTogether = 1;
using Register = float32x4_t;
struct Mask {
    uint32x4_t v;
};

ETSPLAT_FN Register r_set(float a) { return vdupq_n_f32(a); }
ETSPLAT_FN Register r_load(const float* p) { return vld1q_f32(p); }
ETSPLAT_FN void r_store(float* p, Register a) { vst1q_f32(p, a); }
ETSPLAT_FN Register r_add(Register a, Register b) { return vaddq_f32(a, b); }
ETSPLAT_FN Register r_sub(Register a, Register b) { return vsubq_f32(a, b); }
ETSPLAT_FN Register r_mul(Register a, Register b) { return vmulq_f32(a, b); }
ETSPLAT_FN Register r_div(Register a, Register b) { return vdivq_f32(a, b); }
ETSPLAT_FN Register r_reciprocal(Register a) { return vdivq_f32(vdupq_n_f32(1.0f), a); }
ETSPLAT_FN Register r_fma(Register a, Register b, Register c) { return vfmaq_f32(c, a, b); }
ETSPLAT_FN Register r_min(Register a, Register b) { return vminq_f32(a, b); }
ETSPLAT_FN Register r_max(Register a, Register b) { return vmaxq_f32(a, b); }
ETSPLAT_FN Register r_sqrt(Register a) { return vsqrtq_f32(a); }
ETSPLAT_FN Register r_floor(Register a) { return vrndmq_f32(a); }
ETSPLAT_FN Mask r_lt(Register a, Register b) { return {vcltq_f32(a, b)}; }
ETSPLAT_FN Mask r_le(Register a, Register b) { return {vcleq_f32(a, b)}; }
ETSPLAT_FN Register r_select(Mask m, Register a, Register b) { return vbslq_f32(m.v, a, b); }
ETSPLAT_FN Register r_keep(Mask m, Register a) {
    return vreinterpretq_f32_u32(vandq_u32(m.v, vreinterpretq_u32_f32(a)));
}
ETSPLAT_FN Mask m_and(Mask a, Mask b) { return {vandq_u32(a.v, b.v)}; }
ETSPLAT_FN Mask m_or(Mask a, Mask b) { return {vorrq_u32(a.v, b.v)}; }
ETSPLAT_FN Mask m_andnot(Mask a, Mask b) { return {vbicq_u32(a.v, b.v)}; }
ETSPLAT_FN uint32x4_t lane_bits() {
    const uint32_t bits[4] = {1, 2, 4, 8};
    return vld1q_u32(bits);
}
ETSPLAT_FN unsigned m_bits(Mask a) { return vaddvq_u32(vandq_u32(a.v, lane_bits())); }
ETSPLAT_FN Mask m_from_bits(unsigned bits) { return {vtstq_u32(vdupq_n_u32(bits), lane_bits())}; }

ETSPLAT_FN void r_split(Register x, Register& mantissa, Register& exponent) {
    const int32x4_t bits = vreinterpretq_s32_f32(x);
    const int32x4_t above = vsubq_s32(bits, vdupq_n_s32(0x3f400000));
    mantissa = vreinterpretq_f32_s32(vsubq_s32(bits, vandq_s32(above, vdupq_n_s32(-(1 << 23)))));
    exponent = vcvtq_f32_s32(vshrq_n_s32(above, 23));
}
ETSPLAT_FN Register r_scale(Register a, Register shifted) {
    return vreinterpretq_f32_s32(vaddq_s32(vreinterpretq_s32_f32(a), vshlq_n_s32(vreinterpretq_s32_f32(shifted), 23)));
}

// out[k] lane i = table[index of lane i + k]
ETSPLAT_FN void r_lookup4(const float* table, Register index, Register out[4]) {
    int32_t at[4];
    vst1q_s32(at, vcvtq_s32_f32(index));
    const float32x4x2_t even = vzipq_f32(vld1q_f32(table + at[0]), vld1q_f32(table + at[2]));
    const float32x4x2_t odd = vzipq_f32(vld1q_f32(table + at[1]), vld1q_f32(table + at[3]));
    for (int half = 0; half < 2; ++half) {
        const float32x4x2_t columns = vzipq_f32(even.val[half], odd.val[half]);
        out[2 * half] = columns.val[0];
        out[2 * half + 1] = columns.val[1];
    }
}

// Sums of the lanes of four vectors, in order.
ETSPLAT_FN Register r_column_sums(const Register v[4]) {
    return vpaddq_f32(vpaddq_f32(v[0], v[1]), vpaddq_f32(v[2], v[3]));
}

}  // namespace etsplat::neon
