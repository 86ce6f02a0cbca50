// Opaque triangles into the z-buffer of a tile: the spans of some rows at once, then samples of a row side by side.
//
// Nearly all triangles have a few rows of a few samples, so that what is done for each row is most of the work.
#pragma once

#include "cpu/opaque_pass.h"
#include "pack.h"

namespace etsplat::ETSPLAT_SIMD {

constexpr int kOpaqueRows = 8;       // at once
constexpr int32_t kOpaqueAhead = 8;  // triangles of a tile: they lie anywhere in memory

struct OpaqueRows {
    int32_t begin[kOpaqueRows], end[kOpaqueRows];  // columns
    float inverse_depth[kOpaqueRows];              // at the first column of the triangle's bounds
};

// Rows from y on, whether they are the triangle's or not.
ETSPLAT_FN void opaque_rows(const OpaqueTriangle& t, int32_t y, int32_t width, OpaqueRows& rows) {
    double sample_y[kOpaqueRows], first[kOpaqueRows], second[kOpaqueRows];
    for (int r = 0; r < kOpaqueRows; ++r) sample_y[r] = (y + r) + 0.5;
    for (int r = 0; r < kOpaqueRows; ++r) {
        const bool above = sample_y[r] < t.lower.y;
        const OpaqueEdge edge{above ? t.upper.x : t.lower.x, above ? t.upper.y : t.lower.y,
                              above ? t.upper.slope : t.lower.slope, above ? t.upper.x_low : t.lower.x_low,
                              above ? t.upper.x_high : t.lower.x_high};
        first[r] = t.whole.clamped(sample_y[r], width);
        second[r] = edge.clamped(sample_y[r], width);
    }
    for (int r = 0; r < kOpaqueRows; ++r) {
        const int32_t a = next_sample(first[r]), b = next_sample(second[r]);
        rows.begin[r] = a < b ? a : b;
        rows.end[r] = a < b ? b : a;
        rows.inverse_depth[r] = t.row_inverse_depth(y + r);
    }
}

// The nearest wins, of equally near ones the one before.
ETSPLAT_FN void draw_opaque_row(const OpaqueTriangle& t, int32_t index, float row, float slope, int32_t offset,
                                int32_t count, float* depths, int32_t* owners) {
    for (int32_t done = 0; done < count; done += kLanesPerRegister) {
        for (int32_t i = done; i < done + kLanesPerRegister; ++i) {
            const float w = t.inverse_depth_at(row, slope, offset + i);
            const bool nearer = (w > depths[i]) & (i < count);
            depths[i] = nearer ? w : depths[i];
            owners[i] = nearer ? index : owners[i];
        }
    }
}

inline void draw_opaque(const OpaqueTriangle* triangles, const int32_t* indices, int64_t count, const OpaqueTile& tile) {
    static_assert(kLanesPerRegister <= kMostAtATime);
    for (int64_t i = 0; i < count; ++i) {
        if (i + kOpaqueAhead < count) prefetch_all(triangles[indices[i + kOpaqueAhead]]);
        const int32_t index = indices[i];
        const OpaqueTriangle t = triangles[index];  // a copy, which no store can alias
        const auto slope = static_cast<float>(t.inverse_depth_dx);
        const int32_t y_end = t.bounds.y_end < tile.y1 ? t.bounds.y_end : tile.y1;
        OpaqueRows rows;
        for (int32_t y = t.bounds.y_begin > tile.y0 ? t.bounds.y_begin : tile.y0; y < y_end; y += kOpaqueRows) {
            opaque_rows(t, y, tile.width, rows);
            for (int32_t r = 0; r < kOpaqueRows && y + r < y_end; ++r) {
                const int32_t begin = rows.begin[r] > tile.x0 ? rows.begin[r] : tile.x0;
                const int32_t end = rows.end[r] < tile.x1 ? rows.end[r] : tile.x1;
                const int64_t place = static_cast<int64_t>(y + r - tile.y0) * tile.stride + (begin - tile.x0);
                draw_opaque_row(t, index, rows.inverse_depth[r], slope, begin - t.bounds.x_begin, end - begin,
                                tile.inverse_depth + place, tile.triangle + place);
            }
        }
    }
}

}  // namespace etsplat::ETSPLAT_SIMD
