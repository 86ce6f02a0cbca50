// Colours by spherical harmonics of sixteen triangles in lanes (math/spherical_harmonics.h: soup_color and its gradient,
// with the same bits), whose sums over bases are chains that one triangle after the other would wait for.
#pragma once

#include "cpu/colors_pass.h"
#include "pack.h"

namespace etsplat::ETSPLAT_SIMD {

constexpr int kMostCoefficients = 3 * (kMaxShBases - 1);

// rows[16 i + lane]: number i of the lane's row, of `count` numbers that lie `count` behind those of the lane before.
ETSPLAT_FN void load_rows_apart(const float* in, int count, float* rows) {
    for (int at = 0; at < count; at += kLanes) {
        if (count < kLanes) {
            for (int lane = 0; lane < kLanes; ++lane)
                for (int i = 0; i < count; ++i) rows[kLanes * i + lane] = in[count * lane + i];
            return;
        }
        const int from = at + kLanes <= count ? at : count - kLanes;
        Vec lanes[kLanes];
        for (int lane = 0; lane < kLanes; ++lane) lanes[lane] = Vec::load(in + count * lane + from);
        store_transposed(lanes, rows + kLanes * from);
    }
}

// And back.
ETSPLAT_FN void store_rows_apart(const float* rows, int count, float* out) {
    for (int at = 0; at < count; at += kLanes) {
        if (count < kLanes) {
            for (int lane = 0; lane < kLanes; ++lane)
                for (int i = 0; i < count; ++i) out[count * lane + i] = rows[kLanes * i + lane];
            return;
        }
        const int from = at + kLanes <= count ? at : count - kLanes;
        Vec numbers[kLanes];
        alignas(64) float lanes[kLanes * kLanes];
        for (int i = 0; i < kLanes; ++i) numbers[i] = Vec::load(rows + kLanes * (from + i));
        store_transposed(numbers, lanes);
        for (int lane = 0; lane < kLanes; ++lane) Vec::load(lanes + kLanes * lane).store(out + count * lane + from);
    }
}

// One group of triangles, seen from one view after the other.
struct ColorGroup {
    Vector3<Vec> middle;
    Vec dc[3];
    alignas(64) float rest[kMostCoefficients * kLanes];

    ETSPLAT_FN ColorGroup(const ColorsPass& pass, int64_t first) {
        alignas(64) float corners[9 * kLanes];
        load_rows_apart(&pass.corners[3 * first].x, 9, corners);
        Vector3<Vec> corner[3];
        for (int k = 0; k < 3; ++k) {
            const float* at = corners + 3 * k * kLanes;
            corner[k] = {Vec::load(at), Vec::load(at + kLanes), Vec::load(at + 2 * kLanes)};
        }
        middle = Vec(1.0f / 3.0f) * (corner[0] + corner[1] + corner[2]);
        deinterleave3(pass.dc + 3 * first, dc);
        if (pass.degree > 0) {
            expect(pass, pass.rest, first);
            load_rows_apart(pass.rest + 3 * pass.bases * first, static_cast<int>(3 * pass.bases), rest);
        }
    }

    // Asks for the coefficients of a group to come, or for where their gradients go: no processor foresees rows that are
    // read column by column.
    ETSPLAT_FN static void expect(const ColorsPass& pass, const float* rest, int64_t first) {
        constexpr int64_t kAhead = 2 * kColorGroup;
        if (first + kAhead + kColorGroup > pass.triangles) return;
        const int64_t row = 3 * pass.bases;
        for (int64_t i = 0; i < row * kColorGroup; i += 16) prefetch(rest + row * (first + kAhead) + i);
    }

    // Returns the lanes that have a direction.
    ETSPLAT_FN VecMask look(const ColorsPass& pass, int64_t view, Vector3<Vec>& unit, Vec& length, Vec* basis) const {
        const Vector3<float> center = pass.centers[view];
        unit = direction(middle - Vector3<Vec>{Vec(center.x), Vec(center.y), Vec(center.z)}, length);
        sh_basis(pass.degree, unit, basis);
        return length > Vec(kMinLength);
    }

    ETSPLAT_FN Vec coefficient(int basis, int channel) const {
        return Vec::load(rest + (3 * (basis - 1) + channel) * kLanes);
    }
};

inline void colors_forward(const ColorsPass& pass, int64_t first, float* colors) {
    const ColorGroup group(pass, first);
    const int bases = (pass.degree + 1) * (pass.degree + 1);
    for (int64_t view = 0; view < pass.views; ++view) {
        Vector3<Vec> unit;
        Vec length, basis[kMaxShBases], color[3];
        const VecMask seen = group.look(pass, view, unit, length, basis);
        for (int c = 0; c < 3; ++c) {
            const Vec constant = Vec(0.5f) + Vec(kSh0) * group.dc[c];
            Vec sum = constant;
            for (int k = 1; k < bases; ++k) sum = sum + basis[k] * group.coefficient(k, c);
            sum = vselect(seen, sum, constant);
            color[c] = keep(sum > Vec(0.0f), sum);
        }
        interleave3(color, colors + 3 * (view * pass.triangles + first));
    }
}

ETSPLAT_FN VecMask is_zero(Vec a) { return (a <= Vec(0.0f)) & (a >= Vec(0.0f)); }

inline void colors_backward(const ColorsPass& pass, int64_t first, const ColorsGradients& out) {
    const ColorGroup group(pass, first);
    ColorGroup::expect(pass, out.rest, first);
    const int bases = (pass.degree + 1) * (pass.degree + 1), count = static_cast<int>(3 * pass.bases);
    alignas(64) float grad_rest[kMostCoefficients * kLanes];
    for (int i = 0; i < count; ++i) Vec(0.0f).store(grad_rest + kLanes * i);
    Vec grad_dc[3] = {Vec(0.0f), Vec(0.0f), Vec(0.0f)};
    Vector3<Vec> moved{Vec(0.0f), Vec(0.0f), Vec(0.0f)};
    for (int64_t view = 0; view < pass.views; ++view) {
        const int64_t at = 3 * (view * pass.triangles + first);
        Vec color[3], cotangent[3];
        deinterleave3(out.colors + at, color);
        deinterleave3(out.grad_colors + at, cotangent);
        for (int c = 0; c < 3; ++c) {  // a colour of 0 was clamped and passes no gradient
            cotangent[c] = keep(color[c] > Vec(0.0f), cotangent[c]);
            grad_dc[c] = grad_dc[c] + Vec(kSh0) * cotangent[c];
        }
        const VecMask hidden = is_zero(cotangent[0]) & is_zero(cotangent[1]) & is_zero(cotangent[2]);
        if (pass.degree == 0 || hidden.bits() == 0xffffu) continue;  // nobody of the group is in view
        Vector3<Vec> unit;
        Vec length, basis[kMaxShBases], along[kMaxShBases];
        const VecMask seen = and_not(group.look(pass, view, unit, length, basis), hidden);
        for (int k = 1; k < bases; ++k) {
            along[k] = Vec(0.0f);
            for (int c = 0; c < 3; ++c) {
                float* sum = grad_rest + (3 * (k - 1) + c) * kLanes;
                (Vec::load(sum) + keep(seen, cotangent[c] * basis[k])).store(sum);
                along[k] = along[k] + cotangent[c] * group.coefficient(k, c);
            }
        }
        const Vector3<Vec> g = sh_basis_backward(pass.degree, unit, along);
        const Vector3<Vec> by = (Vec(1.0f) / length) * (g - dot(g, unit) * unit);  // through the normalisation
        moved = moved + Vector3<Vec>{keep(seen, by.x), keep(seen, by.y), keep(seen, by.z)};
    }
    interleave3(grad_dc, out.dc + 3 * first);
    store_rows_apart(grad_rest, count, out.rest + 3 * pass.bases * first);
    alignas(64) float corners[9 * kLanes];
    const Vector3<Vec> each = Vec(1.0f / 3.0f) * moved;
    for (int k = 0; k < 3; ++k) {
        each.x.store(corners + 3 * k * kLanes);
        each.y.store(corners + (3 * k + 1) * kLanes);
        each.z.store(corners + (3 * k + 2) * kLanes);
    }
    store_rows_apart(corners, 9, &out.corners[3 * first].x);
}

}  // namespace etsplat::ETSPLAT_SIMD
