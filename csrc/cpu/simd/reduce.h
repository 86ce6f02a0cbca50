// Last stage of the backward pass for sixteen triangles at a time: the slots of each triangle are added up in order, and
// the sums become gradients.
#pragma once

#include <string.h>

#include "triangles.h"

namespace etsplat::ETSPLAT_SIMD {

// Sums the touched slots of each triangle into rows (16, stride), in order, from -0 on, which changes no number; returns the
// lanes that have any.
ETSPLAT_FN unsigned sum_slots(const RasterPass& pass, const TrianglePass& triangles, const LaneRange& range, float* rows) {
    constexpr int kAhead = 32;
    const int stride = pass.slot_layout.stride();
    const int32_t* begin = triangles.slot_begin + range.first;
    unsigned any = 0;
    for (int i = 0; i < range.count; ++i) {
        for (int j = 0; j < stride; j += kLanes) {
            Vec sum(-0.0f);
            for (int32_t s = begin[i]; s < begin[i + 1]; ++s) {
                const float* slot = pass.slots + int64_t{s} * stride + j;
                prefetch(slot + kAhead * kLanes);
                if (!pass.touched[s]) continue;
                sum = sum + Vec::load(slot);
                any |= 1u << i;
            }
            sum.store(rows + i * stride + j);
        }
    }
    for (int i = range.count; i < kLanes; ++i) memset(rows + i * stride, 0, sizeof(float) * static_cast<size_t>(stride));
    return any;
}

// Sums of sixteen triangles with one lane each.
struct LaneSums {
    const float* planes;  // (stride, 16)

    ETSPLAT_FN Vec operator[](int j) const { return Vec::load(planes + kLanes * j); }
};

ETSPLAT_FN double lane_total(Vec v) {
    float lanes[kLanes];
    v.store(lanes);
    double total = 0.0;
    for (int i = 0; i < kLanes; ++i) total += static_cast<double>(lanes[i]);
    return total;
}

// Lanes outside of `drawn` may not even be finite; their gradients by view and screen are 0 already.
ETSPLAT_FN void add_camera_gradient(VecMask drawn, const Vec* world, Vec* view, const Vec* grad_view, const Vec* gx,
                                    const Vec* gy, ChunkSums& chunk) {
    for (int k = 0; k < 9; ++k) view[k] = vselect(drawn, view[k], Vec(1.0f));
    camera_gradient(world, view, grad_view, gx, gy, [&](int number, const Vec* a, const Vec* b) {
        chunk.camera[number] += lane_total(vfma(a[2], b[2], vfma(a[1], b[1], a[0] * b[0])));
    });
}

ETSPLAT_FN void write_vertex_gradients(const TrianglePass& triangles, const LaneRange& range, const Vec world[9]) {
    float lanes[9][kLanes];
    for (int j = 0; j < 9; ++j) world[j].store(lanes[j]);
    if (triangles.grad_corners) {
        float* out = triangles.grad_corners + 9 * range.first;
        for (int i = 0; i < range.count; ++i)
            for (int j = 0; j < 9; ++j) out[9 * i + j] = lanes[j][i];
    } else {
        float* out = triangles.grad_vertices + 9 * range.first;
        for (int i = 0; i < range.count; ++i)
            for (int j = 0; j < 9; ++j) out[9 * i + j] += lanes[j][i];
    }
}

ETSPLAT_FN void geometry_gradients(const RasterPass& pass, const TrianglePass& triangles, const LaneRange& range,
                                   const LaneSums& sums, VecMask any, ChunkSums& chunk) {
    Vec corners[9], view[9], grad_view[9], gx[3], gy[3], grad_world[9];
    Triangle2D<Vec> t;
    load_corners(triangles, range, corners);
    project_triangle(triangles.camera, triangles.near_plane, triangles.distance, corners, view, t);
    view_gradient(triangles.camera, triangles.distance, triangles.freeze_inradius, pass.slot_layout, sums, view, t, grad_view,
                  gx, gy);
    for (int k = 0; k < 9; ++k) {
        grad_view[k] = keep(any, grad_view[k]);  // other lanes may not even be finite
        corners[k] = keep(any, corners[k]);
    }
    for (int k = 0; k < 3; ++k) {
        gx[k] = keep(any, gx[k]);
        gy[k] = keep(any, gy[k]);
    }
    if (triangles.want_camera) add_camera_gradient(any, corners, view, grad_view, gx, gy, chunk);
    if (!triangles.grad_corners && !triangles.grad_vertices) return;
    for (int k = 0; k < 3; ++k) to_world_gradient(triangles.camera, grad_view + 3 * k, grad_world + 3 * k);
    write_vertex_gradients(triangles, range, grad_world);
}

// The sums that are gradients already.
ETSPLAT_FN void add_direct_gradients(const RasterPass& pass, const TrianglePass& triangles, const LaneRange& range,
                                     const float* rows, unsigned any) {
    const SlotLayout& layout = pass.slot_layout;
    const int flat = pass.flat_channels, corner = 3 * pass.corner_channels, stride = layout.stride();
    for (int i = 0; i < range.count; ++i) {
        if ((any >> i & 1) == 0) continue;
        const float* row = rows + i * stride;
        const int64_t triangle = range.first + i;
        if (triangles.grad_flat)
            for (int c = 0; c < flat; ++c) triangles.grad_flat[triangle * flat + c] += row[SlotLayout::kFlat + c];
        if (triangles.grad_corner_colors)
            for (int c = 0; c < corner; ++c) triangles.grad_corner_colors[triangle * corner + c] += row[layout.corner() + c];
    }
}

// scratch: reduce_scratch_size floats
inline ChunkSums reduce_chunk(const RasterPass& pass, const TrianglePass& triangles, int64_t begin, int64_t end,
                              float* scratch) {
    const int stride = pass.slot_layout.stride();
    float* rows = scratch;
    float* planes = scratch + kLanes * stride;
    const bool want_geometry = triangles.want_camera || triangles.grad_corners || triangles.grad_vertices;
    ChunkSums chunk{};
    for (int64_t first = begin; first < end; first += kLanes) {
        const LaneRange range(first, end);
        const unsigned any = sum_slots(pass, triangles, range, rows);
        if (any == 0) {
            if (triangles.grad_corners)
                memset(triangles.grad_corners + 9 * first, 0, sizeof(float) * 9 * static_cast<size_t>(range.count));
            continue;
        }
        for (int j = 0; j < stride; j += kLanes) {
            Vec columns[kLanes];
            for (int i = 0; i < kLanes; ++i) columns[i] = Vec::load(rows + i * stride + j);
            store_transposed(columns, planes + kLanes * j);
        }
        const LaneSums sums{planes};
        add_direct_gradients(pass, triangles, range, rows, any);
        if (triangles.grad_opacities) range.add(triangles.grad_opacities, sums[SlotLayout::kOpacity]);
        if (triangles.grad_sigmas) range.add(triangles.grad_sigmas, sums[SlotLayout::kSigma]);
        chunk.sigma += lane_total(sums[SlotLayout::kSigma]);
        if (want_geometry) geometry_gradients(pass, triangles, range, sums, VecMask::from_bits(any), chunk);
    }
    return chunk;
}

}  // namespace etsplat::ETSPLAT_SIMD
