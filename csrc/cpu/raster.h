// The CPU rasterizer: one call renders one view.
//
//   simd/project.h       vertices -> TriangleRecord, visibility, statistics, tiles
//   raster_bin.cpp       depth sort, then a stable counting sort of (triangle, tile) pairs by tile
//   simd/tile_*.h        the tile loops
//   simd/reduce.h        sums of the slots of each triangle -> gradients of vertices, colours, ...
//   raster_reduce.cpp    sums over triangles, vertices and tiles
//   raster.cpp           forward and backward as sequences of these stages
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "buffer.h"
#include "math/triangle.h"
#include "raster_pass.h"
#include "stage_clock.h"
#include "triangle_pass.h"

namespace etsplat {

// Everything a call needs; the Python side owns the memory, and keeps it for as long as the call runs, no longer. Null
// where an optional tensor is absent.
struct RasterCall {
    const float* vertices = nullptr;  // (N, 3, 3), or (V, 3) with faces
    const int32_t* faces = nullptr;   // (N, 3)
    int64_t num_triangles = 0, num_vertices = 0;
    const float *flat_colors = nullptr, *corner_colors = nullptr;  // (N, flat_channels), (N, 3, corner_channels)
    int flat_channels = 0, corner_channels = 0;
    const float *opacities = nullptr, *sigmas = nullptr;  // (N), (N) or one
    bool shared_sigma = false;
    const float *viewmat = nullptr, *K = nullptr;  // 16 and 9 floats, row-major
    const float* background = nullptr;             // (channels)
    const float* kernel_table = nullptr;           // of kernel "Tabulated"
    int width = 0, height = 0, kernel = 0, distance = 0;
    bool freeze_inradius = false;
    float near_plane = 0.01f, alpha_min = 0, alpha_max = 1, x_max = 2, transmittance_min = 0;
    float distortion_near = 0.2f, distortion_far = 100.0f;
    bool centroid_depth = false;  // depth of the distortion: the centroid's, not the pixel's
    bool keep_for_backward = false;

    float *color = nullptr, *alpha = nullptr, *distortion = nullptr, *distortion_totals = nullptr;
    int32_t* median_triangle = nullptr;
    float *max_weight = nullptr, *screen_size = nullptr, *inradius = nullptr;  // (N)
    bool* visible = nullptr;                                                   // (N)
};

// Gradients in and out; outputs are added to.
struct RasterGradients {
    const float *grad_color = nullptr, *grad_alpha = nullptr, *grad_distortion = nullptr;
    float *vertices = nullptr, *flat_colors = nullptr, *corner_colors = nullptr, *opacities = nullptr;
    float *sigmas = nullptr, *background = nullptr;
    float *viewmat = nullptr, *K = nullptr;  // 16 and 9 floats
};

struct RasterState {
    RasterCall call;
    RasterPass pass;
    TrianglePass triangles;
    std::vector<ChunkTotals> chunk_totals;  // of projection
    Buffer<TriangleRecord> records;
    Buffer<AttributeRecord> attributes;
    Buffer<uint32_t> keys, keys_swap;         // depth bits of the visible triangles
    Buffer<int32_t> order, order_swap;        // visible triangles, front to back
    Buffer<TileSpan> spans;                   // per triangle
    Buffer<int32_t> slot_begin;
    Buffer<int32_t> slot_tile;                // per slot
    Buffer<int32_t> histogram, tile_begin, tile_done;
    Buffer<TileEntry> entries;
    Buffer<uint16_t> hits;
    Buffer<float> slot_weight, slots, corner_gradients, vertex_gradients, tile_background;
    Buffer<uint8_t> touched;
    int64_t num_slots = 0;
    StageSeconds stages[kStages];

    int64_t bytes() const;
};

void bin_triangles(RasterState& state, const TriangleKernels& kernels);
void reduce_gradients(RasterState& state, const RasterGradients& gradients);

std::shared_ptr<RasterState> raster_forward(const RasterCall& call);
// `call` is that of the forward pass, with where its arrays lie now.
void raster_backward(RasterState& state, const RasterCall& call, const RasterGradients& gradients);

}  // namespace etsplat
