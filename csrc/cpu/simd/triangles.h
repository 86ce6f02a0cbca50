// Sixteen triangles in lanes: their corners, and the tiles that a triangle touches.
#pragma once

#include "cpu/triangle_pass.h"
#include "tile.h"

namespace etsplat::ETSPLAT_SIMD {

// Triangles first .. first + count - 1 of a pass; count < 16 in the last block only.
struct LaneRange {
    int64_t first;
    int count;

    ETSPLAT_FN LaneRange(int64_t begin, int64_t end)
        : first(begin), count(end - begin < kLanes ? static_cast<int>(end - begin) : kLanes) {}
    ETSPLAT_FN unsigned bits() const { return (1u << count) - 1u; }

    // One float per triangle; 0 past the last.
    ETSPLAT_FN Vec load(const float* values) const {
        if (count == kLanes) return Vec::load(values + first);
        float lanes[kLanes] = {};
        for (int i = 0; i < count; ++i) lanes[i] = values[first + i];
        return Vec::load(lanes);
    }
    ETSPLAT_FN void store(float* values, Vec v) const {
        if (count == kLanes) return v.store(values + first);
        float lanes[kLanes];
        v.store(lanes);
        for (int i = 0; i < count; ++i) values[first + i] = lanes[i];
    }
    ETSPLAT_FN void add(float* values, Vec v) const { store(values, load(values) + v); }
};

// World positions of the corners, (3, 3).
ETSPLAT_FN void load_corners(const TrianglePass& triangles, const LaneRange& range, Vec world[9]) {
    alignas(64) float lanes[9][kLanes];
    for (int i = 0; i < kLanes; ++i) {
        const int64_t triangle = range.first + (i < range.count ? i : 0);
        for (int k = 0; k < 3; ++k) {
            const int64_t corner = 3 * triangle + k;
            const float* v = triangles.vertices + 3 * (triangles.faces ? int64_t{triangles.faces[corner]} : corner);
            for (int c = 0; c < 3; ++c) lanes[3 * k + c][i] = v[c];
        }
    }
    for (int j = 0; j < 9; ++j) world[j] = Vec::load(lanes[j]);
}

// Calls body(column, row, bits) for patches of 4x4 tiles that hold all tiles touched by a triangle: bit 4 r + c tells
// whether it touches the tile r rows and c columns further.
template <class F>
ETSPLAT_FN void for_each_patch(const RasterPass& pass, const TriangleRecord& record, F&& body) {
    alignas(64) static constexpr float kColumns[16] = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
    alignas(64) static constexpr float kRows[16] = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};
    const SupportBox<float> box{record.left, record.right, record.top, record.bottom};
    const TileRange<float> range(box, record.qx, record.qy, pass.width, pass.height);
    if (!range.any) return;
    DistanceForms<Vec> forms{Vec(record.qx), Vec(record.qy), {}, {}};
    for (int k = 0; k < 3; ++k) {
        forms.gx[k] = Vec(record.gx[k]);
        forms.gy[k] = Vec(record.gy[k]);
    }
    const TileTest<Vec> test(forms, Vec(record.extent));
    for (float row = range.top; row <= range.bottom; row += 4.0f)
        for (float column = range.left; column <= range.right; column += 4.0f) {
            const Vec x = Vec::load(kColumns) + Vec(column), y = Vec::load(kRows) + Vec(row);
            const VecMask touched = test.touches(x, y) & (x <= Vec(range.right)) & (y <= Vec(range.bottom));
            body(static_cast<int>(column), static_cast<int>(row), touched.bits());
        }
}

}  // namespace etsplat::ETSPLAT_SIMD
