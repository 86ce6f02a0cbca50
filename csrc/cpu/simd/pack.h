// Sixteen float lanes on every instruction set: one AVX-512 register, two of AVX2, four of NEON or of the compiler's own.
//
// The engine is written once against Vec and VecMask, and what is evaluated for several vectors at once against Wide, which
// is as many as keep the processor busy: a chain of dependent operations alone does not. ETSPLAT_SIMD names the instruction set that this translation unit
// is compiled for (CMakeLists.txt); everything lives in the namespace of that name, so that no function compiled for a
// wide instruction set can be linked into a narrow one. For the same reason these headers use no std:: templates.
#pragma once

#include <string.h>

#include "cpu/prefetch.h"
#include "math/portable.h"

#define ETSPLAT_STRING_(x) #x
#define ETSPLAT_STRING(x) ETSPLAT_STRING_(x)
#define ETSPLAT_SIMD_HEADER(x) ETSPLAT_STRING(x.h)
#include ETSPLAT_SIMD_HEADER(ETSPLAT_SIMD)

namespace etsplat::ETSPLAT_SIMD {

constexpr int kLanes = 16;
constexpr int kLanesPerRegister = kLanes / kRegisters;

template <int N>
struct PackMask {
    Mask m[N];

    ETSPLAT_FN unsigned bits() const {
        static_assert(N * kLanesPerRegister <= 32);
        unsigned bits = 0;
        for (int i = 0; i < N; ++i) bits |= m_bits(m[i]) << (i * kLanesPerRegister);
        return bits;
    }
    ETSPLAT_FN static PackMask from_bits(unsigned bits) {
        PackMask mask;
        for (int i = 0; i < N; ++i) mask.m[i] = m_from_bits(bits >> (i * kLanesPerRegister));
        return mask;
    }
};

template <int N>
struct Pack {
    Register r[N];

    Pack() = default;
    ETSPLAT_FN explicit Pack(float a) {
        for (int i = 0; i < N; ++i) r[i] = r_set(a);
    }
    ETSPLAT_FN static Pack load(const float* p) {
        Pack v;
        for (int i = 0; i < N; ++i) v.r[i] = r_load(p + i * kLanesPerRegister);
        return v;
    }
    ETSPLAT_FN void store(float* p) const {
        for (int i = 0; i < N; ++i) r_store(p + i * kLanesPerRegister, r[i]);
    }
};

using Vec = Pack<kRegisters>;
using VecMask = PackMask<kRegisters>;
using Wide = Pack<kTogether * kRegisters>;  // vectors side by side
using WideMask = PackMask<kTogether * kRegisters>;

ETSPLAT_FN void put(Wide& wide, int vector, Vec v) {
    for (int i = 0; i < kRegisters; ++i) wide.r[vector * kRegisters + i] = v.r[i];
}
ETSPLAT_FN Vec vector_of(const Wide& wide, int vector) {
    Vec v;
    for (int i = 0; i < kRegisters; ++i) v.r[i] = wide.r[vector * kRegisters + i];
    return v;
}
ETSPLAT_FN VecMask vector_of(const WideMask& wide, int vector) {
    VecMask mask;
    for (int i = 0; i < kRegisters; ++i) mask.m[i] = wide.m[vector * kRegisters + i];
    return mask;
}

#define ETSPLAT_LANEWISE(name, op)                                 \
    template <int N>                                               \
    ETSPLAT_FN Pack<N> name(Pack<N> a, Pack<N> b) {                \
        for (int i = 0; i < N; ++i) a.r[i] = op(a.r[i], b.r[i]);   \
        return a;                                                  \
    }
ETSPLAT_LANEWISE(operator+, r_add)
ETSPLAT_LANEWISE(operator-, r_sub)
ETSPLAT_LANEWISE(operator*, r_mul)
ETSPLAT_LANEWISE(operator/, r_div)
ETSPLAT_LANEWISE(vmin, r_min)
ETSPLAT_LANEWISE(vmax, r_max)
#undef ETSPLAT_LANEWISE

#define ETSPLAT_EACH(name, op)                             \
    template <int N>                                       \
    ETSPLAT_FN Pack<N> name(Pack<N> a) {                   \
        for (int i = 0; i < N; ++i) a.r[i] = op(a.r[i]);   \
        return a;                                          \
    }
ETSPLAT_EACH(vreciprocal, r_reciprocal)
ETSPLAT_EACH(vfloor, r_floor)
ETSPLAT_EACH(vsqrt, r_sqrt)
#undef ETSPLAT_EACH

#define ETSPLAT_COMPARE(name, op)                                   \
    template <int N>                                                \
    ETSPLAT_FN PackMask<N> name(Pack<N> a, Pack<N> b) {             \
        PackMask<N> mask;                                           \
        for (int i = 0; i < N; ++i) mask.m[i] = op(a.r[i], b.r[i]); \
        return mask;                                                \
    }
ETSPLAT_COMPARE(operator<, r_lt)
ETSPLAT_COMPARE(operator<=, r_le)
#undef ETSPLAT_COMPARE
template <int N>
ETSPLAT_FN PackMask<N> operator>(Pack<N> a, Pack<N> b) {
    return b < a;
}
template <int N>
ETSPLAT_FN PackMask<N> operator>=(Pack<N> a, Pack<N> b) {
    return b <= a;
}

#define ETSPLAT_MASKWISE(name, op)                                \
    template <int N>                                              \
    ETSPLAT_FN PackMask<N> name(PackMask<N> a, PackMask<N> b) {   \
        for (int i = 0; i < N; ++i) a.m[i] = op(a.m[i], b.m[i]);  \
        return a;                                                 \
    }
ETSPLAT_MASKWISE(operator&, m_and)
ETSPLAT_MASKWISE(operator|, m_or)
ETSPLAT_MASKWISE(and_not, m_andnot)
#undef ETSPLAT_MASKWISE

// a b + c, with one rounding where the instruction set has it
template <int N>
ETSPLAT_FN Pack<N> vfma(Pack<N> a, Pack<N> b, Pack<N> c) {
    for (int i = 0; i < N; ++i) c.r[i] = r_fma(a.r[i], b.r[i], c.r[i]);
    return c;
}
template <int N>
ETSPLAT_FN Pack<N> vselect(PackMask<N> mask, Pack<N> a, Pack<N> b) {
    for (int i = 0; i < N; ++i) a.r[i] = r_select(mask.m[i], a.r[i], b.r[i]);
    return a;
}
// a where mask, else 0
template <int N>
ETSPLAT_FN Pack<N> keep(PackMask<N> mask, Pack<N> a) {
    for (int i = 0; i < N; ++i) a.r[i] = r_keep(mask.m[i], a.r[i]);
    return a;
}
template <int N>
ETSPLAT_FN Pack<N> vabs(Pack<N> a) {
    return vmax(a, Pack<N>(0.0f) - a);
}

template <int N>
ETSPLAT_FN bool vany(PackMask<N> mask) {
    unsigned set = 0;
    for (int i = 0; i < N; ++i) set |= m_bits(mask.m[i]);
    return set != 0;
}
// x = mantissa 2^exponent with mantissa in [3/4, 3/2), for positive normal numbers
template <int N>
ETSPLAT_FN void vsplit(Pack<N> x, Pack<N>& mantissa, Pack<N>& exponent) {
    for (int i = 0; i < N; ++i) r_split(x.r[i], mantissa.r[i], exponent.r[i]);
}
// A whole number n plus this has n in its lowest bits, and any number of magnitude below 2^22 plus it is rounded to the
// nearest (to even).
constexpr float kWhole = 12582912.0f;  // 1.5 * 2^23
// a 2^n, of n + kWhole
template <int N>
ETSPLAT_FN Pack<N> vscale_shifted(Pack<N> a, Pack<N> shifted) {
    for (int i = 0; i < N; ++i) a.r[i] = r_scale(a.r[i], shifted.r[i]);
    return a;
}
// a 2^n for whole numbers n
template <int N>
ETSPLAT_FN Pack<N> vscale(Pack<N> a, Pack<N> n) {
    return vscale_shifted(a, n + Pack<N>(kWhole));
}
// A float of a table at each lane's index, a whole number; four in a row.
ETSPLAT_FN Vec vlookup(const float* table, Vec index) {
    float lanes[kLanes];
    index.store(lanes);
    for (int i = 0; i < kLanes; ++i) lanes[i] = table[static_cast<int>(lanes[i])];
    return Vec::load(lanes);
}
template <int N>
ETSPLAT_FN void vlookup4(const float* table, Pack<N> index, Pack<N>* out) {
    for (int i = 0; i < N; ++i) {
        Register columns[4];
        r_lookup4(table, index.r[i], columns);
        for (int k = 0; k < 4; ++k) out[k].r[i] = columns[k];
    }
}

// log2 of a positive normal number: minimax polynomial of log2(1 + t) / t on [-1/4, 1/2], relative error 1.8e-7.
template <int N>
ETSPLAT_FN Pack<N> vlog2(Pack<N> x) {
    using Vec = Pack<N>;
    Vec mantissa, exponent;
    vsplit(x, mantissa, exponent);
    const Vec t = mantissa - Vec(1.0f);
    Vec p = Vec(-0.0958695665f);
    p = vfma(p, t, Vec(0.203868653f));
    p = vfma(p, t, Vec(-0.250627248f));
    p = vfma(p, t, Vec(0.290098712f));
    p = vfma(p, t, Vec(-0.36033908f));
    p = vfma(p, t, Vec(0.480846831f));
    p = vfma(p, t, Vec(-0.721350623f));
    p = vfma(p, t, Vec(1.44269525f));
    return vfma(p, t, exponent);
}

// 2^x for x <= 126: minimax polynomial on [-1/2, 1/2], relative error 1e-7. Below -100 it stays at 2^-100, so that
// products with it are no denormals, which cost some processors a hundred cycles.
template <int N>
ETSPLAT_FN Pack<N> vexp2(Pack<N> x) {
    using Vec = Pack<N>;
    x = vmax(x, Vec(-100.0f));
    const Vec shifted = x + Vec(kWhole);
    const Vec f = x - (shifted - Vec(kWhole));
    Vec p = Vec(0.00132764188f);
    p = vfma(p, f, Vec(0.00967554163f));
    p = vfma(p, f, Vec(0.0555071344f));
    p = vfma(p, f, Vec(0.240221197f));
    p = vfma(p, f, Vec(0.693146967f));
    p = vfma(p, f, Vec(1.00000007f));
    return vscale_shifted(p, shifted);
}

ETSPLAT_FN float lane_sum(Vec a) {
    float lanes[kLanes];
    a.store(lanes);
    for (int width = kLanes / 2; width > 0; width /= 2)
        for (int i = 0; i < width; ++i) lanes[i] += lanes[i + width];
    return lanes[0];
}

ETSPLAT_FN float lane_max(Vec a) {
    float lanes[kLanes];
    a.store(lanes);
    for (int width = kLanes / 2; width > 0; width /= 2)
        for (int i = 0; i < width; ++i) lanes[i] = etsplat::vmax(lanes[i], lanes[i + width]);
    return lanes[0];
}

// out[i] = sum of the lanes of v[i], i < 16.
ETSPLAT_FN void column_sums(const Vec v[kLanes], float* out) {
    Register sums[kLanes];
    for (int i = 0; i < kLanes; ++i) {
        sums[i] = v[i].r[0];
        for (int j = 1; j < kRegisters; ++j) sums[i] = r_add(sums[i], v[i].r[j]);
    }
    for (int i = 0; i < kLanes; i += kLanesPerRegister) r_store(out + i, r_column_sums(sums + i));
}

// Whether an instruction set moves lanes between wide registers: r_transpose, r_load_apart, r_deinterleave3, r_interleave3.
constexpr bool kMovesLanes = kLanesPerRegister > 4;

// out[16 i + j] = lane i of v[j]
template <class R = Register>
ETSPLAT_FN void store_transposed(const Vec v[kLanes], float* out) {
    if constexpr (kMovesLanes) {
        for (int first = 0; first < kLanes; first += kLanesPerRegister)
            for (int part = 0; part < kRegisters; ++part) {
                R columns[kLanesPerRegister], rows[kLanesPerRegister];
                for (int i = 0; i < kLanesPerRegister; ++i) columns[i] = v[first + i].r[part];
                r_transpose(columns, rows);
                for (int i = 0; i < kLanesPerRegister; ++i)
                    r_store(out + kLanes * (part * kLanesPerRegister + i) + first, rows[i]);
            }
    } else {
        float lanes[kLanes];
        for (int j = 0; j < kLanes; ++j) {
            v[j].store(lanes);
            for (int i = 0; i < kLanes; ++i) out[kLanes * i + j] = lanes[i];
        }
    }
}

// Each four lanes from `apart` floats behind those before: what was written four at a time is not there yet for a wider load.
template <class R = Register>
ETSPLAT_FN Vec load_apart(const float* in, int apart) {
    if constexpr (kMovesLanes) {
        Vec v;
        for (int i = 0; i < kRegisters; ++i) {
            R lanes;
            r_load_apart(in + i * kLanesPerRegister / 4 * apart, apart, lanes);
            v.r[i] = lanes;
        }
        return v;
    } else {
        float lanes[kLanes];
        for (int quad = 0; quad < 4; ++quad) memcpy(lanes + 4 * quad, in + quad * apart, 16);
        return Vec::load(lanes);
    }
}

// Sixteen pixels of three channels to one vector per channel, and back.
template <class R = Register>
ETSPLAT_FN void deinterleave3(const float* in, Vec out[3]) {
    if constexpr (kMovesLanes) {
        for (int part = 0; part < kRegisters; ++part) {
            R registers[3];
            r_deinterleave3(in + 3 * kLanesPerRegister * part, registers);
            for (int c = 0; c < 3; ++c) out[c].r[part] = registers[c];
        }
    } else {
        float planes[3][kLanes];
        for (int i = 0; i < kLanes; ++i)
            for (int c = 0; c < 3; ++c) planes[c][i] = in[3 * i + c];
        for (int c = 0; c < 3; ++c) out[c] = Vec::load(planes[c]);
    }
}
template <class R = Register>
ETSPLAT_FN void interleave3(const Vec in[3], float* out) {
    if constexpr (kMovesLanes) {
        for (int part = 0; part < kRegisters; ++part) {
            const R registers[3] = {in[0].r[part], in[1].r[part], in[2].r[part]};
            r_interleave3(registers, out + 3 * kLanesPerRegister * part);
        }
    } else {
        float planes[3][kLanes];
        for (int c = 0; c < 3; ++c) in[c].store(planes[c]);
        for (int i = 0; i < kLanes; ++i)
            for (int c = 0; c < 3; ++c) out[3 * i + c] = planes[c][i];
    }
}

}  // namespace etsplat::ETSPLAT_SIMD
