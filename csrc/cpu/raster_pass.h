// What the tile loops (simd/raster_kernels.cpp) read and write: one view, after projection, sorting and binning.
//
// The image is cut into tiles of 16x16 pixels, a tile into 16 blocks of 4x4. Both distances of the paper have the form
// x(p) = max_k g_k . (p - q), so a tile loop knows nothing of vertices: it needs q and the three g_k.
#pragma once

#include <cstdint>

#include "math/kernels.h"
#include "math/raster_records.h"
#include "math/tiles.h"

namespace etsplat {

constexpr int kBlocks = 16;  // blocks in a tile, and lanes in a block
constexpr int kFastChannels = 3;

// What the tile loops are compiled for: three constant channels, three interpolated ones, or anything.
enum class Shape : int { kFlat, kCorner, kGeneral };
constexpr int kShapes = 3;

struct TileEntry {
    int32_t triangle;
    int32_t slot;  // of the gradients; a triangle's slots are consecutive
};

struct RasterPass {
    int width = 0, height = 0, tiles_x = 0, tiles_y = 0;
    int kernel = 0;
    const float* kernel_table = nullptr;  // of a kernel from Python (math/kernel_table.h)
    int flat_channels = 0, corner_channels = 0;
    bool attributes = false;  // anything interpolated: corner colours, or distortion with per-pixel depth
    DistortionDepth distortion_depth = DistortionDepth::kNone;
    bool want_distortion = false, want_median = false;
    float alpha_min = 0, alpha_max = 1, transmittance_min = 0;
    float distortion_near = 0.2f, distortion_far = 100.0f;

    const TriangleRecord* records = nullptr;
    const AttributeRecord* attribute_records = nullptr;
    const float* flat_colors = nullptr;    // (N, flat_channels)
    const float* corner_colors = nullptr;  // (N, 3, corner_channels)
    const float* background = nullptr;     // (channels) or null for black
    const int32_t* tile_begin = nullptr;   // (tiles + 1)
    const TileEntry* entries = nullptr;    // by tile, front to back
    uint16_t* hits = nullptr;              // per slot: blocks in which the triangle was drawn or stopped a pixel
    int32_t* tile_done = nullptr;          // per tile: end of the entries that were looked at
    float* slot_weight = nullptr;          // per slot: largest blend weight, or null

    float* color = nullptr;                   // (H, W, flat + corner channels)
    float* alpha = nullptr;                   // (H, W)
    float* distortion = nullptr;              // (H, W) or null
    float* distortion_totals = nullptr;       // (H, W, 2): sum w m, sum w m^2
    int32_t* median_triangle = nullptr;       // (H, W) or null: 1 + index, 0 where T stays above one half

    // backward
    const float* grad_color = nullptr;
    const float* grad_alpha = nullptr;       // or null
    const float* grad_distortion = nullptr;  // or null
    SlotLayout slot_layout;
    float* slots = nullptr;                  // (slots, stride)
    uint8_t* touched = nullptr;              // per slot: did the backward pass write it?
    float* tile_background = nullptr;        // (tiles, channels) or null

    int channels() const { return flat_channels + corner_channels; }
    Shape shape() const {
        if (channels() != kFastChannels || want_distortion || want_median) return Shape::kGeneral;
        return corner_channels == 0 ? Shape::kFlat : flat_channels == 0 ? Shape::kCorner : Shape::kGeneral;
    }
    // floats of scratch memory that a tile loop needs
    int64_t scratch_size() const { return 16384 + int64_t{768} * channels() + 64 * slot_layout.stride(); }
};

using TileFunction = void (*)(const RasterPass& pass, int tile, float* scratch);

// For benchmarks: work of the tile loops.
struct TileCounts {
    int64_t pairs = 0;             // (triangle, tile) pairs looked at before the tile was full
    int64_t forward_vectors = 0;   // blocks of 16 pixels in which the forward pass evaluates a triangle
    int64_t backward_vectors = 0;  // ... the backward pass
    int64_t drawn = 0;             // pixels in which a triangle is drawn
};
using TileCounter = void (*)(const RasterPass& pass, int tile, float* scratch, TileCounts& counts);
using EvaluationLoop = void (*)(const float* table, const float* x, int count, float exponent, float scale, float* out);

struct RasterKernels {
    TileFunction forward[kKernels][kShapes];  // [kernel][shape]
    TileFunction backward[kKernels][kShapes];
    // diagnostics [kernel]
    TileCounter count[kKernels];
    EvaluationLoop value_loop[kKernels], gradient_loop[kKernels];
};

}  // namespace etsplat
