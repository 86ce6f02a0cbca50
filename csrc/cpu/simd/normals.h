// Agreement of normals with those of the depth image over a band of rows, with derivatives, row by row: a row of
// agreements is computed when the rows around it are there, and the derivatives by the depths of a row when the
// agreements above and below it are. Sixteen columns at a time, the last ones one by one.
#pragma once

#include "cpu/normals_pass.h"
#include "pack.h"

namespace etsplat::ETSPLAT_SIMD {
namespace {

alignas(64) constexpr float kColumns[kLanes] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};

template <class T>
ETSPLAT_FN T load(const float* p) {
    return T::load(p);
}
template <>
ETSPLAT_FN float load<float>(const float* p) {
    return *p;
}
ETSPLAT_FN void store(float* p, float value) { *p = value; }
ETSPLAT_FN void store(float* p, Vec value) { value.store(p); }
ETSPLAT_FN void store_normal(float* p, Vector3<float> n) {
    p[0] = n.x;
    p[1] = n.y;
    p[2] = n.z;
}

// One row of agreements: derivatives by both differences, each component an array of `width`.
struct AgreementRow {
    float* by_down[3];
    float* by_right[3];

    AgreementRow(float* storage, int64_t width) {
        for (int c = 0; c < 3; ++c) {
            by_down[c] = storage + c * width;
            by_right[c] = storage + (3 + c) * width;
        }
    }
    void clear(int64_t width) {
        for (int c = 0; c < 3; ++c) {
            for (int64_t j = 0; j < width; ++j) by_down[c][j] = by_right[c][j] = 0.0f;
        }
    }
};

template <class T>
ETSPLAT_FN Agreement<T> agree(const DepthView& view, const float* above, const float* here, const float* below, T row,
                              T column, Vector3<T> normal, T alpha) {
    const DepthCross<T> z{load<T>(above), load<T>(below), load<T>(here - 1), load<T>(here + 1)};
    return agreement(view, depth_slopes(view, z, row, column), normal, alpha);
}

template <class T>
ETSPLAT_FN void store_slopes(const AgreementRow& out, int64_t j, const DepthSlopes<T>& by_slopes) {
    const Vector3<T>&down = by_slopes.down, &right = by_slopes.right;
    const T components[6] = {down.x, down.y, down.z, right.x, right.y, right.z};
    for (int c = 0; c < 3; ++c) {
        store(out.by_down[c] + j, components[c]);
        store(out.by_right[c] + j, components[3 + c]);
    }
}

// Fills `out`; where `own`, returns the sum of the values and writes the derivatives by the normals.
inline double agree_row(const NormalsPass& pass, int64_t row, const AgreementRow& out, bool own) {
    const int64_t width = pass.width, end = width - 1;
    const float *above = pass.depth + (row - 1) * width, *here = above + width, *below = here + width;
    const float *normals = pass.normals + 3 * row * width, *alpha = pass.alpha + row * width;
    float* by_normals = own && pass.by_normals ? pass.by_normals + 3 * row * width : nullptr;
    const float y = static_cast<float>(row);
    double sums[kLanes] = {};
    int64_t j = 1;
    for (; j + kLanes <= end; j += kLanes) {
        Vec n[3];
        deinterleave3(normals + 3 * j, n);
        const Vec column = Vec::load(kColumns) + Vec(static_cast<float>(j));
        const Agreement<Vec> a = agree(pass.view, above + j, here + j, below + j, Vec(y), column,
                                       Vector3<Vec>{n[0], n[1], n[2]}, Vec::load(alpha + j));
        store_slopes(out, j, a.by_slopes);
        const Vec by_normal[3] = {a.by_normal.x, a.by_normal.y, a.by_normal.z};
        if (by_normals) interleave3(by_normal, by_normals + 3 * j);
        float values[kLanes];
        a.value.store(values);
        for (int i = 0; i < kLanes; ++i) sums[i] += static_cast<double>(values[i]);
    }
    for (; j < end; ++j) {
        const float* n = normals + 3 * j;
        const Agreement<float> a = agree(pass.view, above + j, here + j, below + j, y, static_cast<float>(j),
                                         Vector3<float>{n[0], n[1], n[2]}, alpha[j]);
        store_slopes(out, j, a.by_slopes);
        if (by_normals) store_normal(by_normals + 3 * j, a.by_normal);
        sums[0] += static_cast<double>(a.value);
    }
    double sum = 0.0;
    for (int i = 0; i < kLanes && own; ++i) sum += sums[i];
    return sum;
}

inline void depth_row(const NormalsPass& pass, int64_t row, const AgreementRow& above, const AgreementRow& here,
                      const AgreementRow& below) {
    float* __restrict to = pass.by_depth + row * pass.width;
    const DepthView view = pass.view;
    const float y = static_cast<float>(row);
    const auto at = [&](int64_t j, float left, float right) {
        // `left` and `right`: whether there are such pixels
        const int64_t before = left > 0.0f ? j - 1 : j, after = right > 0.0f ? j + 1 : j;
        float point[3];
        for (int c = 0; c < 3; ++c) {
            point[c] = above.by_down[c][j] - below.by_down[c][j] + left * here.by_right[c][before] -
                       right * here.by_right[c][after];
        }
        const float x = static_cast<float>(static_cast<int32_t>(j));
        return along_ray(view, {point[0], point[1], point[2]}, y, x);
    };
    const int64_t last = pass.width - 1;
    to[0] = at(0, 0.0f, last > 0 ? 1.0f : 0.0f);
    for (int64_t j = 1; j < last; ++j) to[j] = at(j, 1.0f, 1.0f);
    if (last > 0) to[last] = at(last, 1.0f, 0.0f);
}

double normals_band(const NormalsPass& pass, int64_t first, int64_t last, float* scratch) {
    const int64_t width = pass.width;
    AgreementRow rows[3] = {{scratch, width}, {scratch + 6 * width, width}, {scratch + 12 * width, width}};
    for (AgreementRow& row : rows) row.clear(width);
    const auto row_at = [&](int64_t i) -> AgreementRow& { return rows[(i + 3) % 3]; };
    const bool wanted = pass.by_depth != nullptr;
    double sum = 0.0;
    for (int64_t i = first - 1; i <= last; ++i) {  // row i of agreements, then row i - 1 of depths
        const bool own = i >= first && i < last, inside = i >= 1 && i < pass.height - 1;
        if (own && pass.by_normals) {
            float* to = pass.by_normals + 3 * i * width;
            for (int64_t j = 0; j < 3 * width; ++j) to[j] = 0.0f;
        }
        if (inside && (own || wanted)) sum += agree_row(pass, i, row_at(i), own);
        if (!inside && wanted) row_at(i).clear(width);
        if (wanted && i - 1 >= first) depth_row(pass, i - 1, row_at(i - 2), row_at(i - 1), row_at(i));
    }
    return sum;
}

}  // namespace
}  // namespace etsplat::ETSPLAT_SIMD
