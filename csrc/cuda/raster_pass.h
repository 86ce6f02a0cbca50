// What the rasterizer's kernels read and write. The host fills it from the declarations below (engines/cuda/structs.py), so
// each member is a pointer, int or float, on one line with others of its type. Null where an optional tensor is absent.
// The first ones are the inputs in the order in which the host has them (engines/native/plan.py).
//
// Views are rendered together. "Projected triangle" m = view * triangles + triangle; "tile" counts through all views.
#pragma once

#include "cuda/common.h"
#include "math/kernels.h"
#include "math/raster_records.h"
#include "math/tiles.h"
#include "math/triangle.h"

namespace etsplat {

struct RasterPass {
    const float *vertices, *flat_colors, *corner_colors, *opacities, *sigmas, *viewmats, *Ks, *backgrounds, *kernel_table;
    const int* faces;
    int triangles, vertex_count, views, width, height, tiles_x, tiles_y, kernel, distance, freeze_inradius;
    int shared_sigma, flat_per_view, corner_per_view, flat_channels, corner_channels, capacity;
    float near_plane, support_alpha, alpha_min, alpha_max, x_max, transmittance_min, distortion_near, distortion_far;

    // Per projected triangle: the records, the tiles it touches, its first slot.
    float *records, *attributes;
    unsigned *depth_keys, *spans, *slot_begin;
    const unsigned* order;
    // Per slot, that is (projected triangle, tile) pair, numbered in drawing order of the triangles.
    unsigned *slot_tile, *slot_triangle;
    unsigned char* hits;
    // Slots by tile, front to back, with the range of each tile and the end of what its pixels looked at.
    const unsigned *sorted_tiles, *sorted_slots;
    // `tile_order` is the tiles as blocks take them.
    int *tile_ranges, *tile_done, *tile_order;
    // Device-side numbers: slots wanted, slots there are; look-back words and ticket of the scan. `overflow` outlives a call.
    long long *wanted, *overflow;
    unsigned *slots, *scan_ticket;
    unsigned long long* scan_state;

    float *color, *alpha, *distortion, *distortion_totals, *max_weight, *screen_size, *inradius;
    int* median_triangle;
    unsigned char* visible;

    // Backward.
    const float *grad_color, *grad_alpha, *grad_distortion;
    float *slot_sums, *tile_background, *grad_corners, *grad_flat, *grad_corner_colors, *grad_opacities, *grad_sigmas;
    double *sigma_sums, *camera_sums;
};

// A triangle's tiles, from tile `first` on, as a word: up to kPatternSide rows and columns as a bit pattern (row-major), or
// their number with kMany set, where the box is larger and has to be searched.
struct alignas(8) Span {
    unsigned first, word;
};
constexpr int kPatternSide = 4;
constexpr unsigned kMany = 0x80000000u;
__device__ __forceinline__ Span& span_of(const RasterPass& pass, int m) { return reinterpret_cast<Span*>(pass.spans)[m]; }
__device__ __forceinline__ unsigned span_count(unsigned word) { return word & kMany ? word & ~kMany : __popc(word); }

__device__ __forceinline__ TriangleRecord load_record(const RasterPass& pass, int m) {
    return reinterpret_cast<const TriangleRecord*>(pass.records)[m];
}

__device__ __forceinline__ PinholeCamera load_camera(const RasterPass& pass, int view) {
    return pinhole_camera(pass.viewmats + 16 * view, pass.Ks + 9 * view);
}

// World positions of the corners; false if an index is out of range.
__device__ __forceinline__ bool load_corners(const RasterPass& pass, int triangle, float* world) {
    bool valid = true;
    for (int k = 0; k < 3; ++k) {
        long long corner = 3ll * triangle + k;
        if (pass.faces) {
            const int index = pass.faces[corner];
            valid = valid && index >= 0 && index < pass.vertex_count;
            corner = valid ? index : 0;
        }
        for (int c = 0; c < 3; ++c) world[3 * k + c] = pass.vertices[3 * corner + c];
    }
    return valid;
}

__device__ __forceinline__ const float* flat_colors_of(const RasterPass& pass, int m) {
    return pass.flat_colors + static_cast<long long>(pass.flat_per_view ? m : m % pass.triangles) * pass.flat_channels;
}
__device__ __forceinline__ const float* corner_colors_of(const RasterPass& pass, int m) {
    const int row = pass.corner_per_view ? m : m % pass.triangles;
    return pass.corner_colors + static_cast<long long>(row) * 3 * pass.corner_channels;
}

}  // namespace etsplat
