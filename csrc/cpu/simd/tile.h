// Geometry of a tile in lanes: which pixels a block holds, and which blocks a triangle can touch.
#pragma once

#include <stdint.h>
#include <string.h>

#if defined(_MSC_VER) && !defined(__clang__)
#include <intrin.h>
#endif

#include "cpu/raster_pass.h"
#include "math/interpolation.h"
#include "math/kernels.h"
#include "pack.h"

namespace etsplat::ETSPLAT_SIMD {

// Offsets of the lanes in a block and of the block centres in a tile, in pixels from the first pixel centre.
alignas(64) constexpr float kLaneX[16] = {-1.5f, -.5f, .5f, 1.5f, -1.5f, -.5f, .5f, 1.5f,
                                          -1.5f, -.5f, .5f, 1.5f, -1.5f, -.5f, .5f, 1.5f};
alignas(64) constexpr float kLaneY[16] = {-1.5f, -1.5f, -1.5f, -1.5f, -.5f, -.5f, -.5f, -.5f,
                                          .5f,   .5f,   .5f,   .5f,   1.5f, 1.5f, 1.5f, 1.5f};
alignas(64) constexpr float kBlockX[16] = {1.5f, 5.5f, 9.5f, 13.5f, 1.5f, 5.5f, 9.5f, 13.5f,
                                           1.5f, 5.5f, 9.5f, 13.5f, 1.5f, 5.5f, 9.5f, 13.5f};
alignas(64) constexpr float kBlockY[16] = {1.5f, 1.5f, 1.5f,  1.5f,  5.5f,  5.5f,  5.5f,  5.5f,
                                           9.5f, 9.5f, 9.5f, 9.5f, 13.5f, 13.5f, 13.5f, 13.5f};
constexpr float kBlockReach = 1.5f;

struct TileFrame {
    int x0, y0;           // first pixel
    int columns, rows;    // pixels inside the image

    ETSPLAT_FN TileFrame(const RasterPass& pass, int tile)
        : x0(tile % pass.tiles_x * kTile), y0(tile / pass.tiles_x * kTile) {
        columns = pass.width - x0 < kTile ? pass.width - x0 : kTile;
        rows = pass.height - y0 < kTile ? pass.height - y0 : kTile;
    }
    ETSPLAT_FN bool whole() const { return columns == kTile && rows == kTile; }
    // Lanes of a block that lie inside the image
    ETSPLAT_FN unsigned inside(int block) const {
        unsigned bits = 0;
        for (int lane = 0; lane < 16; ++lane) {
            const bool in = block % 4 * 4 + lane % 4 < columns && block / 4 * 4 + lane / 4 < rows;
            bits |= (in ? 1u : 0u) << lane;
        }
        return bits;
    }
    // Index of the first pixel of a block row in an image of the given width
    ETSPLAT_FN int64_t pixel(int block, int row, int width) const {
        return static_cast<int64_t>(y0 + block / 4 * 4 + row) * width + x0 + block % 4 * 4;
    }
    ETSPLAT_FN int row_count(int block) const { return clamp4(rows - block / 4 * 4); }
    ETSPLAT_FN int column_count(int block) const { return clamp4(columns - block % 4 * 4); }

private:
    ETSPLAT_FN static int clamp4(int n) { return n < 0 ? 0 : n > 4 ? 4 : n; }
};

// A tile row of 16 pixels lies in four blocks, four lanes each: to and from that layout. `plane` is [block][16].
ETSPLAT_FN void store_row(float* plane, int row, Vec values) {
    float lanes[16];
    values.store(lanes);
    float* out = plane + row / 4 * 64 + row % 4 * 4;
    for (int column = 0; column < 4; ++column) memcpy(out + 16 * column, lanes + 4 * column, 16);
}
ETSPLAT_FN Vec load_row(const float* plane, int row) { return load_apart(plane + row / 4 * 64 + row % 4 * 4, 16); }

// The three forms g_k . (p - q) of a triangle over one tile.
struct TriangleForms {
    float at_block[3][16];     // values at the block centres
    float in_block[3][16];     // differences of the lanes to the block centre
    float center_x, center_y;  // first pixel centre - q

    ETSPLAT_FN void prepare(const TriangleRecord& record, const TileFrame& frame) {
        center_x = static_cast<float>(frame.x0) + 0.5f - record.qx;
        center_y = static_cast<float>(frame.y0) + 0.5f - record.qy;
        const Vec block_x = Vec::load(kBlockX) + Vec(center_x), block_y = Vec::load(kBlockY) + Vec(center_y);
        const Vec lane_x = Vec::load(kLaneX), lane_y = Vec::load(kLaneY);
        for (int k = 0; k < 3; ++k) {
            vfma(Vec(record.gx[k]), block_x, Vec(record.gy[k]) * block_y).store(at_block[k]);
            vfma(Vec(record.gx[k]), lane_x, Vec(record.gy[k]) * lane_y).store(in_block[k]);
        }
    }
    // The blocks that the triangle can touch: where the smallest value that each form takes in the block is within the
    // extent, and the bounding boxes overlap. Conservative.
    ETSPLAT_FN unsigned blocks(const TriangleRecord& record) const {
        const Vec x = Vec::load(kBlockX) + Vec(center_x), y = Vec::load(kBlockY) + Vec(center_y);
        const float reach = kBlockReach;
        VecMask mask = (x >= Vec(record.left - reach)) & (x <= Vec(record.right + reach)) &
                       (y >= Vec(record.top - reach)) & (y <= Vec(record.bottom + reach));
        for (int k = 0; k < 3; ++k) {
            const float slack = reach * (etsplat::vabs(record.gx[k]) + etsplat::vabs(record.gy[k]));
            mask = mask & (Vec::load(at_block[k]) <= Vec(record.extent + slack));
        }
        return mask.bits();
    }
    ETSPLAT_FN Vec value(int k, int block) const { return Vec(at_block[k][block]) + Vec::load(in_block[k]); }
    // The normalised distance x of the lanes
    ETSPLAT_FN Vec distance(int block) const { return vmax(value(0, block), vmax(value(1, block), value(2, block))); }
    // p - q of the lanes
    ETSPLAT_FN Vec dx(int block) const { return Vec::load(kLaneX) + Vec(center_x + kBlockX[block]); }
    ETSPLAT_FN Vec dy(int block) const { return Vec::load(kLaneY) + Vec(center_y + kBlockY[block]); }
};

template <Shape kShape>
ETSPLAT_FN int flat_channels(const RasterPass& pass) {
    return kShape == Shape::kFlat ? kFastChannels : kShape == Shape::kCorner ? 0 : pass.flat_channels;
}

ETSPLAT_FN void prefetch_colors(const RasterPass& pass, int32_t triangle) {
    if (pass.flat_channels > 0) prefetch(pass.flat_colors + int64_t{triangle} * pass.flat_channels);
    if (pass.corner_channels > 0) {
        prefetch(pass.attribute_records + triangle);
        prefetch(pass.corner_colors + int64_t{3} * triangle * pass.corner_channels);
    }
}

// All that a tile reads of a triangle.
ETSPLAT_FN void prefetch_triangle(const RasterPass& pass, int32_t triangle) {
    prefetch(pass.records + triangle);
    prefetch_colors(pass, triangle);
}

// Entries of all tiles: behind those of a tile come those of the next, which mostly the same thread draws.
ETSPLAT_FN int entry_count(const RasterPass& pass) { return pass.tile_begin[pass.tiles_x * pass.tiles_y]; }

ETSPLAT_FN float first_inverse_depth(const RasterPass& pass, int tile) {
    const int first = pass.tile_begin[tile];
    if (!pass.want_distortion || first == pass.tile_begin[tile + 1]) return 0.0f;
    return 1.0f / pass.attribute_records[pass.entries[first].triangle].centroid_z;
}

// 1 if any of the 16 bits is set, without a branch.
ETSPLAT_FN unsigned any_bit(unsigned bits) { return (bits + 0xffffu) >> 16; }

ETSPLAT_FN int lowest_bit(unsigned bits) {
#if defined(_MSC_VER) && !defined(__clang__)
    unsigned long index;
    _BitScanForward(&index, bits);
    return static_cast<int>(index);
#else
    return __builtin_ctz(bits);
#endif
}

template <class F>
ETSPLAT_FN void for_each_bit(unsigned bits, F&& body) {
    for (; bits != 0; bits &= bits - 1) body(lowest_bit(bits));
}

}  // namespace etsplat::ETSPLAT_SIMD
