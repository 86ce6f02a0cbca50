// Stage 1 for sixteen triangles at a time: vertices to records, depth, statistics and the tiles that are touched.
#pragma once

#include <string.h>

#include <bit>

#include "math/kernels.h"
#include "triangles.h"

namespace etsplat::ETSPLAT_SIMD {

// Lanes whose `size` consecutive values are all finite.
ETSPLAT_FN unsigned finite_rows(const float* values, int size, const LaneRange& range) {
    const float* first = values + range.first * size;
    const int total = size * range.count;
    Vec differences(0.0f);  // value - value: NaN for Inf and NaN
    int j = 0;
    for (; j + kLanes <= total; j += kLanes) differences = differences + (Vec::load(first + j) - Vec::load(first + j));
    float rest = 0.0f;
    for (; j < total; ++j) rest += first[j] - first[j];
    if ((differences <= Vec(0.0f)).bits() == 0xffffu && rest == 0.0f) return range.bits();
    unsigned bits = 0;
    for (int i = 0; i < range.count; ++i) {
        float row = 0.0f;
        for (int c = 0; c < size; ++c) row += first[i * size + c] - first[i * size + c];
        bits |= (row == 0.0f ? 1u : 0u) << i;
    }
    return bits;
}

struct Projected {
    Vec view[9];
    Triangle2D<Vec> triangle;
    DistanceForms<Vec> forms;
    SupportBox<Vec> box;
    Vec extent, depth, opacity, sigma;
    VecMask visible;

    template <class Kernel>
    ETSPLAT_FN void project(const RasterPass& pass, const TrianglePass& triangles, const LaneRange& range) {
        const Vec largest(3.402823466e38f);
        opacity = range.load(triangles.opacities);
        sigma = triangles.shared_sigma ? Vec(*triangles.sigmas) : range.load(triangles.sigmas);
        visible = (opacity > Vec(0.0f)) & (opacity <= largest) & (sigma > Vec(0.0f)) & (sigma <= largest);
        opacity = vselect(visible, opacity, Vec(1.0f));  // no NaN may enter the kernels' integer arithmetic
        sigma = vselect(visible, sigma, Vec(1.0f));
        const Kernel kernel = kernel_with<Kernel>(pass.kernel_table);
        extent = visible_extent(kernel, opacity, sigma, triangles.support_alpha, triangles.x_max);
        Vec world[9];
        load_corners(triangles, range, world);
        visible = visible & (extent > Vec(0.0f)) &
                  project_triangle(triangles.camera, triangles.near_plane, triangles.distance, world, view, triangle);
        forms = distance_forms(triangle);
        box = support_box(triangle, forms.qx, forms.qy, extent);
        depth = centroid_depth(view);
        const unsigned rows = finite_rows(pass.flat_colors, pass.flat_channels, range) &
                              finite_rows(pass.corner_colors, 3 * pass.corner_channels, range);
        visible = visible & VecMask::from_bits(rows) & (depth > Vec(0.0f)) &
                  meets_image(box, forms.qx, forms.qy, pass.width, pass.height);
    }
};

// Rows of the first `size` columns, the rows past the range not written.
ETSPLAT_FN void store_rows(const Vec columns[16], int size, const LaneRange& range, void* out) {
    if (size == kLanes && range.count == kLanes) {
        store_transposed(columns, static_cast<float*>(out));
        return;
    }
    float rows[16 * kLanes];
    store_transposed(columns, rows);
    for (int i = 0; i < range.count; ++i)
        memcpy(static_cast<float*>(out) + i * size, rows + i * kLanes, sizeof(float) * static_cast<size_t>(size));
}

template <class Kernel>
ETSPLAT_FN void write_records(const RasterPass& pass, const TrianglePass& triangles, const LaneRange& range, const Projected& p) {
    static_assert(sizeof(TriangleRecord) == 64 && sizeof(AttributeRecord) == 32);
    const DistanceForms<Vec>& f = p.forms;
    const Kernel kernel = kernel_with<Kernel>(pass.kernel_table);
    const KernelCoefficients<Vec> c = kernel.coefficients(vmax(p.sigma, Vec(kMinSigma)));
    const Vec record[16] = {f.qx,     f.qy,      f.gx[0],    f.gx[1], f.gx[2],    f.gy[0],     f.gy[1],   f.gy[2],
                            p.extent, p.opacity, c.exponent, c.scale, p.box.left, p.box.right, p.box.top, p.box.bottom};
    store_rows(record, 16, range, triangles.records + range.first);
    if (!triangles.attributes) return;
    Vec attributes[16];
    for (int k = 0; k < 3; ++k) {
        attributes[k] = Vec(1.0f) / p.triangle.weight[k];
        attributes[3 + k] = attributes[k] / p.view[3 * k + 2];
    }
    attributes[6] = p.depth;
    for (int k = 7; k < 16; ++k) attributes[k] = Vec(0.0f);
    store_rows(attributes, 8, range, triangles.attributes + range.first);
}

ETSPLAT_FN int32_t tile_count(const RasterPass& pass, const TriangleRecord& record) {
    int32_t count = 0;
    search_tiles(pass, record, [&](const int32_t*, unsigned bits) { for_each_bit(bits, [&](int) { ++count; }); });
    return count;
}

ETSPLAT_FN void write_spans(const RasterPass& pass, const TrianglePass& triangles, const LaneRange& range,
                            const Projected& p, ChunkTotals& totals) {
    const TileRange<Vec> tiles(p.box, p.forms.qx, p.forms.qy, pass.width, pass.height);
    const TileTest<Vec> test(p.forms, p.extent);
    const Vec one(1.0f), right = tiles.left + one, below = tiles.top + one;
    const VecMask seen = p.visible & tiles.any;
    const VecMask wide = seen & (tiles.right > tiles.left), high = seen & (tiles.bottom > tiles.top);
    const VecMask many = seen & ((tiles.right > right) | (tiles.bottom > below));
    const VecMask touched[4] = {seen & test.touches(tiles.left, tiles.top), wide & test.touches(right, tiles.top),
                                high & test.touches(tiles.left, below), wide & high & test.touches(right, below)};
    Vec word(0.0f);
    for (int i = 0; i < 4; ++i)
        word = word + keep(touched[i], Vec(static_cast<float>((1 << i) + static_cast<int>(TileSpan::kCountUnit))));
    float lanes[3][kLanes];
    keep(seen, tiles.left).store(lanes[0]);
    keep(seen, tiles.top).store(lanes[1]);
    word.store(lanes[2]);
    int32_t first[kLanes], words[kLanes];
    for (int i = 0; i < kLanes; ++i) {
        first[i] = static_cast<int32_t>(lanes[1][i]) * pass.tiles_x + static_cast<int32_t>(lanes[0][i]);
        words[i] = static_cast<int32_t>(lanes[2][i]);
    }
    for_each_bit(many.bits(), [&](int i) {
        words[i] = tile_count(pass, triangles.records[range.first + i]) * static_cast<int32_t>(TileSpan::kCountUnit);
    });
    int32_t pairs = 0, some = 0;
    for (int i = 0; i < kLanes; ++i) {
        pairs += words[i] / static_cast<int32_t>(TileSpan::kCountUnit);
        some += words[i] != 0 ? 1 : 0;
    }
    totals.pairs += pairs;
    totals.triangles += some;
    TileSpan spans[kLanes];
    for (int i = 0; i < kLanes; ++i) spans[i] = {first[i], static_cast<uint32_t>(words[i])};
    memcpy(triangles.spans + range.first, spans, sizeof(TileSpan) * static_cast<size_t>(range.count));
}

// Smallest and largest depth of visible triangles.
struct DepthRange {
    Vec low{3e38f}, high{0.0f};

    ETSPLAT_FN void include(const Projected& p) {
        low = vmin(low, vselect(p.visible, p.depth, low));
        high = vmax(high, keep(p.visible, p.depth));
    }
    // Positive floats are ordered like their bits.
    ETSPLAT_FN void store(ChunkTotals& totals) const {
        totals.lowest_key = std::bit_cast<uint32_t>(0.0f - lane_max(Vec(0.0f) - low));
        totals.highest_key = std::bit_cast<uint32_t>(lane_max(high));
    }
};

// Keys of invisible triangles mean nothing.
ETSPLAT_FN void write_keys(const TrianglePass& triangles, const LaneRange& range, const Projected& p) {
    float lanes[kLanes];
    p.depth.store(lanes);
    memcpy(triangles.keys + range.first, lanes, sizeof(float) * static_cast<size_t>(range.count));
}

ETSPLAT_FN void write_statistics(const TrianglePass& triangles, const LaneRange& range, const Projected& p) {
    range.store(triangles.screen_size, keep(p.visible, screen_size(p.triangle)));
    range.store(triangles.inradius, keep(p.visible, inradius(p.triangle)));
    const unsigned bits = p.visible.bits();
    for (int i = 0; i < range.count; ++i) triangles.visible[range.first + i] = (bits >> i & 1) != 0;
}

template <class Kernel>
ChunkTotals project_chunk(const RasterPass& pass, const TrianglePass& triangles, int64_t begin, int64_t end) {
    ChunkTotals totals{};
    DepthRange depths;
    for (int64_t i = begin; i < end; i += kLanes) {
        const LaneRange range(i, end);
        Projected p;
        p.project<Kernel>(pass, triangles, range);
        write_records<Kernel>(pass, triangles, range, p);
        write_spans(pass, triangles, range, p, totals);
        write_keys(triangles, range, p);
        depths.include(p);
        if (triangles.visible) write_statistics(triangles, range, p);
    }
    depths.store(totals);
    return totals;
}

// Numbers the slots of a chunk from `slot` on and lists its triangles that touch any tile, from place `rank` on.
inline void number_chunk(const RasterPass& pass, const TrianglePass& triangles, int64_t begin, int64_t end,
                         int32_t slot, int32_t rank) {
    for (int64_t i = begin; i < end; ++i) {
        const TileSpan span = triangles.spans[i];
        triangles.slot_begin[i] = slot;
        if (span.tiles == 0) continue;
        triangles.order[rank] = static_cast<int32_t>(i);
        triangles.ordered_keys[rank++] = triangles.keys[i];
        if (span.pattern() == 0) {
            int32_t* tile = triangles.slot_tile + slot;
            search_tiles(pass, triangles.records[i], [&](const int32_t* tiles, unsigned bits) {
                for_each_bit(bits, [&](int b) { *tile++ = tiles[b]; });
            });
        }
        slot += static_cast<int32_t>(span.count());
    }
}

}  // namespace etsplat::ETSPLAT_SIMD
