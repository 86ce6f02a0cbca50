// What the triangle loops (simd/triangle_kernels.cpp) read and write: the stages before and after the tile loops.
//
// Triangles are handled in chunks of a fixed size, sixteen at a time; what is summed over triangles is summed by chunk.
#pragma once

#include <cstdint>

#include "raster_pass.h"

namespace etsplat {

constexpr int64_t kTriangleChunk = 1024;

// The tiles that the visible support of a triangle touches. Where two rows and two columns hold them, bit 2 r + c of the
// pattern tells of the tile r rows and c columns after tile `first`; else the pattern is 0, and slot_tile lists them.
struct TileSpan {
    int32_t first;
    uint32_t tiles;

    static constexpr uint32_t kCountUnit = 16;
    uint32_t pattern() const { return tiles % kCountUnit; }
    uint32_t count() const { return tiles / kCountUnit; }
};

struct ChunkTotals {
    int64_t pairs, triangles;  // (triangle, tile) pairs, and triangles with any
    uint32_t lowest_key, highest_key;
};

// Sums over all triangles of one chunk.
struct ChunkSums {
    double sigma;
    double camera[kCameraGradients];
};

struct TrianglePass {
    int64_t count = 0;
    PinholeCamera camera;
    Distance distance = Distance::kBarycentric;
    bool freeze_inradius = false, shared_sigma = false;
    float near_plane = 0, support_alpha = 0, x_max = 0;  // support_alpha: alpha_min, or 0 where it is off
    const float* vertices = nullptr;  // (count, 3, 3), or (V, 3) with faces
    const int32_t* faces = nullptr;   // (count, 3) or null
    const float* opacities = nullptr;
    const float* sigmas = nullptr;

    TriangleRecord* records = nullptr;
    AttributeRecord* attributes = nullptr;  // or null
    uint32_t* keys = nullptr;               // bits of the depth
    TileSpan* spans = nullptr;
    float* screen_size = nullptr;  // statistics; all three or none
    float* inradius = nullptr;
    bool* visible = nullptr;

    // numbering
    int32_t* slot_begin = nullptr;
    int32_t* slot_tile = nullptr;     // of triangles without a pattern
    int32_t* order = nullptr;         // triangles with any tile, in order
    uint32_t* ordered_keys = nullptr;

    // reduction; outputs are added to
    bool want_camera = false;
    float* grad_corners = nullptr;  // (count, 3, 3), written, for shared vertices; or null
    float* grad_vertices = nullptr, *grad_flat = nullptr, *grad_corner_colors = nullptr;
    float* grad_opacities = nullptr, *grad_sigmas = nullptr;
};

struct TriangleKernels {
    using Project = ChunkTotals (*)(const RasterPass&, const TrianglePass&, int64_t begin, int64_t end);
    using Number = void (*)(const RasterPass&, const TrianglePass&, int64_t begin, int64_t end, int32_t slot, int32_t rank);
    using Reduce = ChunkSums (*)(const RasterPass&, const TrianglePass&, int64_t begin, int64_t end, float* scratch);
    Project project[kKernels];  // [kernel]
    Number number;
    Reduce reduce;

    static int64_t reduce_scratch_size(const SlotLayout& layout) { return int64_t{2} * 16 * layout.stride(); }
};

}  // namespace etsplat
