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

alignas(64) constexpr float kLaneNumber[kLanes] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};

// Vertices lie anywhere in memory: asks for those of the triangles that follow the next group.
ETSPLAT_FN void prefetch_corners(const TrianglePass& triangles, const LaneRange& range) {
    const int64_t first = range.first + 2 * kLanes;
    if (!triangles.faces || first + kLanes > triangles.count) return;
    for (const int32_t* corner = triangles.faces + 3 * first; corner < triangles.faces + 3 * (first + kLanes); ++corner)
        prefetch(triangles.vertices + int64_t{3} * *corner);
}

// World positions of the corners, (3, 3).
ETSPLAT_FN void load_corners(const TrianglePass& triangles, const LaneRange& range, Vec world[9]) {
    prefetch_corners(triangles, range);
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

// Calls body(tiles, bits) for the tiles in the bounding box of a triangle's visible support, sixteen at a time: where a
// bit is set, the triangle touches the tile of that place.
template <class F>
ETSPLAT_FN void search_tiles(const RasterPass& pass, const TriangleRecord& record, F&& body) {
    const SupportBox<float> box{record.left, record.right, record.top, record.bottom};
    const TileRange<float> range(box, record.qx, record.qy, pass.width, pass.height);
    if (!range.any) return;
    DistanceForms<Vec> forms{Vec(record.qx), Vec(record.qy), {}, {}};
    for (int k = 0; k < 3; ++k) {
        forms.gx[k] = Vec(record.gx[k]);
        forms.gy[k] = Vec(record.gy[k]);
    }
    const TileTest<Vec> test(forms, Vec(record.extent));
    // row by row: the next sixteen are sixteen columns to the right, less whole rows
    const float columns = range.right - range.left + 1.0f;
    const Vec width(columns), per_width(1.0f / columns), left(range.left), bottom(range.bottom);
    Vec column = Vec::load(kLaneNumber), row(range.top);
    for (float done = 0.0f; done < columns * (range.bottom - range.top + 1.0f); done += static_cast<float>(kLanes)) {
        const Vec whole = vfloor((column + Vec(0.5f)) * per_width);
        column = column - whole * width;
        row = row + whole;
        const VecMask touched = test.touches(left + column, row) & (row <= bottom);
        float lanes[2][kLanes];
        (left + column).store(lanes[0]);
        row.store(lanes[1]);
        int32_t tiles[kLanes];
        for (int i = 0; i < kLanes; ++i)
            tiles[i] = static_cast<int32_t>(lanes[1][i]) * pass.tiles_x + static_cast<int32_t>(lanes[0][i]);
        body(tiles, touched.bits());
        column = column + Vec(static_cast<float>(kLanes));
    }
}

}  // namespace etsplat::ETSPLAT_SIMD
