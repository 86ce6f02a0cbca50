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

// Everything a call needs, by address; the Python side owns the memory, and keeps it for as long as the call runs, no
// longer. 0 where an optional tensor is absent.
struct RasterCall {
    uintptr_t vertices = 0;  // (N, 3, 3), or (V, 3) with faces
    uintptr_t faces = 0;     // (N, 3) int32
    int64_t num_triangles = 0, num_vertices = 0;
    uintptr_t flat_colors = 0, corner_colors = 0;  // (N, flat_channels), (N, 3, corner_channels)
    int flat_channels = 0, corner_channels = 0;
    uintptr_t opacities = 0, sigmas = 0;  // (N), (N) or one
    bool shared_sigma = false;
    uintptr_t viewmat = 0, K = 0;   // 16 and 9 floats, row-major
    uintptr_t background = 0;       // (channels)
    uintptr_t kernel_table = 0;     // of kernel "Tabulated"
    int width = 0, height = 0, kernel = 0, distance = 0;
    bool freeze_inradius = false;
    float near_plane = 0.01f, alpha_min = 0, alpha_max = 1, x_max = 2, transmittance_min = 0;
    float distortion_near = 0.2f, distortion_far = 100.0f;
    bool centroid_depth = false;  // depth of the distortion: the centroid's, not the pixel's
    bool keep_for_backward = false;

    uintptr_t color = 0, alpha = 0;
    uintptr_t distortion = 0, distortion_totals = 0, median_triangle = 0;
    uintptr_t max_weight = 0, screen_size = 0, inradius = 0, visible = 0;  // (N) float, float, float, bool
};

// Gradients in and out; outputs are added to.
struct RasterGradients {
    uintptr_t grad_color = 0, grad_alpha = 0, grad_distortion = 0;
    uintptr_t corner_offsets = 0, corner_indices = 0;  // of each vertex, with faces: where it is used, as 3 face + corner
    uintptr_t vertices = 0, flat_colors = 0, corner_colors = 0, opacities = 0, sigmas = 0, background = 0;
    uintptr_t viewmat = 0, K = 0;  // 16 and 9 floats
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
    Buffer<float> slot_weight, slots, corner_gradients, tile_background;
    Buffer<uint8_t> touched;
    int64_t num_slots = 0;
    StageSeconds stages[kStages];

    int64_t bytes() const;
};

void bin_triangles(RasterState& state, const TriangleKernels& kernels);
void reduce_gradients(RasterState& state, const RasterGradients& gradients);

std::shared_ptr<RasterState> raster_forward(const RasterCall& call);
// `call` is that of the forward pass, with the addresses of now.
void raster_backward(RasterState& state, const RasterCall& call, const RasterGradients& gradients);

}  // namespace etsplat
