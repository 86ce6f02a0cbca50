// What the tile loops share. Specialised by definitions: KERNEL (a struct of math/kernels.h), FLAT and CORNER (channels of
// each kind), DISTORTION (0, 1 plane, 2 centroid), MEDIAN and WEIGHTS (0, 1: wanted).
//
// A block of 256 threads has a tile of 16x16 pixels, each of its 8 warps a sub-tile of 8x4. Triangles are staged in shared
// memory; whether one can touch a sub-tile is decided once for the warp.
#pragma once

#include "cuda/raster_pass.h"
#include "math/interpolation.h"

namespace etsplat {

constexpr int kTileThreads = kTile * kTile;
constexpr int kWarps = kTileThreads / kWarp;
constexpr int kSubWidth = 8, kSubHeight = 4;
constexpr int kChannels = FLAT + CORNER;
static_assert(kChannels <= kMostGpuChannels);
constexpr SlotLayout kLayout{FLAT, CORNER, static_cast<DistortionDepth>(DISTORTION)};
constexpr bool kAttributes = kLayout.attributes();
constexpr int kStride = kLayout.stride();

// Room for attributes only where they are needed.
template <bool Present>
struct StagedAttributes {
    AttributeRecord record;
    __device__ __forceinline__ void set(const AttributeRecord& from) { record = from; }
    __device__ __forceinline__ const AttributeRecord& get() const { return record; }
};
template <>
struct StagedAttributes<false> {
    __device__ __forceinline__ void set(const AttributeRecord&) {}
    __device__ __forceinline__ AttributeRecord get() const { return {}; }
};

struct alignas(kAttributes ? 32 : 16) Staged {
    float qx, qy, extent, opacity, gx[3], exponent, gy[3], scale;
    float color[FLAT > 0 ? FLAT : 1];
    float corner[CORNER > 0 ? 3 * CORNER : 1];
    float centroid_z;
    int triangle;  // in its view
    StagedAttributes<kAttributes> attributes;
};

__device__ __forceinline__ void stage(const RasterPass& pass, Staged& s, const TriangleRecord& r, int m) {
    s.qx = r.qx;
    s.qy = r.qy;
    s.extent = r.extent;
    s.opacity = r.opacity;
    s.exponent = r.exponent;
    s.scale = r.scale;
    for (int k = 0; k < 3; ++k) {
        s.gx[k] = r.gx[k];
        s.gy[k] = r.gy[k];
    }
    s.triangle = m % pass.triangles;
    for (int c = 0; c < FLAT; ++c) s.color[c] = flat_colors_of(pass, m)[c];
    for (int c = 0; c < 3 * CORNER; ++c) s.corner[c] = corner_colors_of(pass, m)[c];
    if (kAttributes) s.attributes.set(reinterpret_cast<const AttributeRecord*>(pass.attributes)[m]);
    if (DISTORTION == 2) s.centroid_z = reinterpret_cast<const AttributeRecord*>(pass.attributes)[m].centroid_z;
}

// Bit w: the triangle may touch sub-tile w of the tile whose first pixel is (x0, y0). Conservative.
__device__ __forceinline__ unsigned sub_tiles(const TriangleRecord& r, int x0, int y0) {
    constexpr float reach_x = 0.5f * (kSubWidth - 1), reach_y = 0.5f * (kSubHeight - 1);
    float slack[3];
    for (int k = 0; k < 3; ++k) slack[k] = r.extent + reach_x * vabs(r.gx[k]) + reach_y * vabs(r.gy[k]);
    unsigned bits = 0;
    for (int w = 0; w < kWarps; ++w) {
        const float x = static_cast<float>(x0 + w % 2 * kSubWidth) + (0.5f + reach_x) - r.qx;
        const float y = static_cast<float>(y0 + w / 2 * kSubHeight) + (0.5f + reach_y) - r.qy;
        bool touched = x >= r.left - reach_x && x <= r.right + reach_x && y >= r.top - reach_y && y <= r.bottom + reach_y;
        for (int k = 0; k < 3; ++k) touched = touched && vfma(r.gx[k], x, r.gy[k] * y) <= slack[k] * (1.0f + 1e-5f) + 1e-5f;
        bits |= (touched ? 1u : 0u) << w;
    }
    return bits;
}

// The tile of this block.
__device__ __forceinline__ int tile_of_block(const RasterPass& pass) {
    return pass.tile_order ? pass.tile_order[blockIdx.x] : static_cast<int>(blockIdx.x);
}

// The pixel of this thread.
struct Pixel {
    int view, x0, y0;     // first pixel of the tile
    float x, y;           // centre
    long long index;      // in the images of the batch
    bool inside;

    __device__ __forceinline__ Pixel(const RasterPass& pass, int tile) {
        const int per_view = pass.tiles_x * pass.tiles_y, in_view = tile % per_view;
        view = tile / per_view;
        x0 = in_view % pass.tiles_x * kTile;
        y0 = in_view / pass.tiles_x * kTile;
        const int column = x0 + warp_index() % 2 * kSubWidth + lane_index() % kSubWidth;
        const int row = y0 + warp_index() / 2 * kSubHeight + lane_index() / kSubWidth;
        inside = column < pass.width && row < pass.height;
        x = static_cast<float>(column) + 0.5f;
        y = static_cast<float>(row) + 0.5f;
        index = inside ? (static_cast<long long>(view) * pass.height + row) * pass.width + column : 0;
    }
};

// p - q and the three forms of a pixel. Written with vfma, so that forward and backward round alike.
struct Forms {
    float dx, dy, form[3], x;

    __device__ __forceinline__ Forms(const Staged& s, const Pixel& pixel) : dx(pixel.x - s.qx), dy(pixel.y - s.qy) {
        for (int k = 0; k < 3; ++k) form[k] = vfma(s.gx[k], dx, s.gy[k] * dy);
        x = vmax(form[0], vmax(form[1], form[2]));
    }
};

// 1/z of the first triangle's centroid; only distortions ask.
__device__ __forceinline__ float first_inverse_depth(const RasterPass& pass, int begin, int end) {
    if (DISTORTION == 0 || begin >= end) return 0.0f;
    const unsigned m = pass.slot_triangle[pass.sorted_slots[begin]];
    return 1.0f / reinterpret_cast<const AttributeRecord*>(pass.attributes)[m].centroid_z;
}

}  // namespace etsplat
