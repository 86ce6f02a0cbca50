// Agreement of normals with those of the depth image over a band of rows, with derivatives, row by row: a row of
// agreements is computed when the rows around it are there, and the derivatives by the depths of a row when the
// agreements above and below it are. Loops over columns of separate arrays, which the compiler vectorises.
#pragma once

#include "cpu/normals_pass.h"

namespace etsplat::ETSPLAT_SIMD {
namespace {

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

// Fills `out`; where `own`, adds the values to the sum and writes the derivatives by the normals.
inline double agree_row(const NormalsPass& pass, int64_t row, const AgreementRow& out, float* scratch, bool own) {
    const int64_t width = pass.width;
    const float *above = pass.depth + (row - 1) * width, *here = above + width, *below = here + width;
    const float *normals = pass.normals + 3 * row * width, *alpha = pass.alpha + row * width;
    float *__restrict nx = scratch, *__restrict ny = nx + width, *__restrict nz = ny + width, *__restrict values = nz + width;
    for (int64_t j = 0; j < width; ++j) {
        nx[j] = normals[3 * j];
        ny[j] = normals[3 * j + 1];
        nz[j] = normals[3 * j + 2];
    }
    float *__restrict down_x = out.by_down[0], *__restrict down_y = out.by_down[1], *__restrict down_z = out.by_down[2];
    float *__restrict right_x = out.by_right[0], *__restrict right_y = out.by_right[1],
          *__restrict right_z = out.by_right[2];
    const DepthView view = pass.view;
    const float y = static_cast<float>(row);
    for (int64_t j = 1; j < width - 1; ++j) {
        const float x = static_cast<float>(static_cast<int32_t>(j));
        const DepthCross z{above[j], below[j], here[j - 1], here[j + 1]};
        const Agreement a = agreement(view, depth_slopes(view, z, y, x), {nx[j], ny[j], nz[j]}, alpha[j]);
        values[j] = a.value;
        nx[j] = a.by_normal.x;
        ny[j] = a.by_normal.y;
        nz[j] = a.by_normal.z;
        down_x[j] = a.by_slopes.down.x;
        down_y[j] = a.by_slopes.down.y;
        down_z[j] = a.by_slopes.down.z;
        right_x[j] = a.by_slopes.right.x;
        right_y[j] = a.by_slopes.right.y;
        right_z[j] = a.by_slopes.right.z;
    }
    if (!own) return 0.0;
    double sum = 0.0;
    for (int64_t j = 1; j < width - 1; ++j) sum += static_cast<double>(values[j]);
    if (pass.by_normals) {
        float* to = pass.by_normals + 3 * row * width;
        for (int64_t j = 1; j < width - 1; ++j) {
            to[3 * j] = nx[j];
            to[3 * j + 1] = ny[j];
            to[3 * j + 2] = nz[j];
        }
    }
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
    float* columns = scratch + 18 * width;
    const auto row_at = [&](int64_t i) -> AgreementRow& { return rows[(i + 3) % 3]; };
    const bool wanted = pass.by_depth != nullptr;
    double sum = 0.0;
    for (int64_t i = first - 1; i <= last; ++i) {  // row i of agreements, then row i - 1 of depths
        const bool own = i >= first && i < last, inside = i >= 1 && i < pass.height - 1;
        if (own && pass.by_normals) {
            float* to = pass.by_normals + 3 * i * width;
            for (int64_t j = 0; j < 3 * width; ++j) to[j] = 0.0f;
        }
        if (inside && (own || wanted)) sum += agree_row(pass, i, row_at(i), columns, own);
        if (!inside && wanted) row_at(i).clear(width);
        if (wanted && i - 1 >= first) depth_row(pass, i - 1, row_at(i - 2), row_at(i - 1), row_at(i));
    }
    return sum;
}

}  // namespace
}  // namespace etsplat::ETSPLAT_SIMD
