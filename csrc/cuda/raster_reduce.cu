// The end of the backward pass: the slots of each triangle are added up in order, and the sums become gradients.
//
//   raster_reduce  a thread per triangle, through all views; triangles with more than kManySlots slots are added up by the
//                  whole warp. What is summed over triangles (one sigma, cameras) is left as a sum per block.
//   raster_gather  a thread per vertex adds the gradients of its corners, in order
// Definitions as in raster_tile.h; every output is written, none is added to.
#include "cuda/block_sum.h"
#include "cuda/raster_tile.h"

namespace etsplat {

constexpr int kReduceBlock = 128;
constexpr unsigned kManySlots = 48;

__device__ __forceinline__ void add_slot(const RasterPass& pass, unsigned slot, float (&sums)[kStride]) {
    if (pass.hits[slot] == 0) return;
    const float4* row = reinterpret_cast<const float4*>(pass.slot_sums + static_cast<long long>(slot) * kStride);
    for (int j = 0; j < kStride / 4; ++j) {
        const float4 four = row[j];
        sums[4 * j] += four.x;
        sums[4 * j + 1] += four.y;
        sums[4 * j + 2] += four.z;
        sums[4 * j + 3] += four.w;
    }
}

// Sums of the slots of projected triangle m, or 0 where `inside` is false; all lanes of a warp together.
__device__ __forceinline__ void sum_slots(const RasterPass& pass, int m, bool inside, float (&sums)[kStride]) {
    for (int j = 0; j < kStride; ++j) sums[j] = 0.0f;
    const unsigned limit = *pass.slots;
    const unsigned begin = inside ? pass.slot_begin[m] : 0, count = inside ? span_count(pass.spans[2 * m + 1]) : 0;
    const unsigned end = begin + count < limit ? begin + count : limit;
    const bool many = end > begin && end - begin > kManySlots;
    if (!many)
        for (unsigned slot = begin; slot < end; ++slot) add_slot(pass, slot, sums);
    for (unsigned lanes = __ballot_sync(kAllLanes, many); lanes != 0; lanes &= lanes - 1) {
        const int lane = __ffs(static_cast<int>(lanes)) - 1;
        const unsigned its_begin = __shfl_sync(kAllLanes, begin, lane), its_end = __shfl_sync(kAllLanes, end, lane);
        float part[kStride];
        for (int j = 0; j < kStride; ++j) part[j] = 0.0f;
        for (unsigned slot = its_begin + lane_index(); slot < its_end; slot += kWarp) add_slot(pass, slot, part);
        for (int j = 0; j < kStride; ++j) {
            const float sum = warp_sum(part[j]);
            if (lane_index() == lane) sums[j] = sum;
        }
    }
}

// Adds a triangle's geometry gradient in one view to grad_world (9), and its part of the camera's (kCameraGradients).
__device__ __forceinline__ void add_geometry(const RasterPass& pass, int triangle, int view_index,
                                             const float (&sums)[kStride], float* grad_world, float* camera_part) {
    const PinholeCamera camera = load_camera(pass, view_index);
    const Distance distance = static_cast<Distance>(pass.distance);
    float world[9], view[9], grad_view[9], gx[3], gy[3];
    Triangle2D<float> t;
    load_corners(pass, triangle, world);
    project_triangle(camera, pass.near_plane, distance, world, view, t);
    const SlotLayout layout = kLayout;
    view_gradient(camera, distance, pass.freeze_inradius != 0, layout, sums, view, t, grad_view, gx, gy);
    for (int k = 0; k < 3; ++k) {
        float grad[3];
        to_world_gradient(camera, grad_view + 3 * k, grad);
        for (int c = 0; c < 3; ++c) grad_world[3 * k + c] += grad[c];
    }
    camera_gradient(world, view, grad_view, gx, gy, [&](int number, const float* a, const float* b) {
        for (int k = 0; k < 3; ++k) camera_part[number] += a[k] * b[k];
    });
}

}  // namespace etsplat

using namespace etsplat;

extern "C" __global__ void __launch_bounds__(128) raster_reduce(const __grid_constant__ RasterPass pass) {
    __shared__ double part[kReduceBlock / kWarp];
    const int triangle = blockIdx.x * kReduceBlock + threadIdx.x;
    const bool inside = triangle < pass.triangles;
    const bool geometry = pass.grad_corners || pass.camera_sums;
    float grad_world[9] = {}, grad_opacity = 0.0f, grad_sigma = 0.0f, flat[FLAT > 0 ? FLAT : 1] = {};
    float corner[CORNER > 0 ? 3 * CORNER : 1] = {};
    for (int view = 0; view < pass.views; ++view) {
        const long long m = static_cast<long long>(view) * pass.triangles + triangle;
        float sums[kStride], camera_part[kCameraGradients] = {};
        sum_slots(pass, static_cast<int>(inside ? m : 0), inside, sums);
        const bool drawn = inside && span_count(pass.spans[2 * m + 1]) > 0;
        // elsewhere not even the projection may be finite
        if (drawn && geometry) add_geometry(pass, triangle, view, sums, grad_world, camera_part);
        grad_opacity += sums[SlotLayout::kOpacity];
        grad_sigma += sums[SlotLayout::kSigma];
        for (int c = 0; c < FLAT; ++c) flat[c] = sums[SlotLayout::kFlat + c] + (pass.flat_per_view ? 0.0f : flat[c]);
        for (int c = 0; c < 3 * CORNER; ++c)
            corner[c] = sums[kLayout.corner() + c] + (pass.corner_per_view ? 0.0f : corner[c]);
        if (inside && pass.grad_flat && (pass.flat_per_view || view == pass.views - 1))
            for (int c = 0; c < FLAT; ++c) pass.grad_flat[(pass.flat_per_view ? m : triangle) * FLAT + c] = flat[c];
        if (inside && pass.grad_corner_colors && (pass.corner_per_view || view == pass.views - 1))
            for (int c = 0; c < 3 * CORNER; ++c)
                pass.grad_corner_colors[(pass.corner_per_view ? m : triangle) * 3 * CORNER + c] = corner[c];
        if (pass.camera_sums)
            for (int j = 0; j < kCameraGradients; ++j) {
                const double sum = block_sum<kReduceBlock>(camera_part[j], part);
                const long long block = static_cast<long long>(view) * gridDim.x + blockIdx.x;
                if (threadIdx.x == 0) pass.camera_sums[block * kCameraGradients + j] = sum;
            }
    }
    if (pass.sigma_sums) {
        const double sum = block_sum<kReduceBlock>(grad_sigma, part);
        if (threadIdx.x == 0) pass.sigma_sums[blockIdx.x] = sum;
    }
    if (!inside) return;
    if (pass.grad_corners)
        for (int j = 0; j < 9; ++j) pass.grad_corners[9ll * triangle + j] = grad_world[j];
    if (pass.grad_opacities) pass.grad_opacities[triangle] = grad_opacity;
    if (pass.grad_sigmas) pass.grad_sigmas[triangle] = grad_sigma;
}

extern "C" __global__ void raster_gather(const float* grad_corners, const int* offsets, const int* corners, int vertices, float* grad_vertices) {
    const int vertex = blockIdx.x * blockDim.x + threadIdx.x;
    if (vertex >= vertices) return;
    float sum[3] = {};
    for (int i = offsets[vertex]; i < offsets[vertex + 1]; ++i)
        for (int c = 0; c < 3; ++c) sum[c] += grad_corners[3ll * corners[i] + c];
    for (int c = 0; c < 3; ++c) grad_vertices[3ll * vertex + c] = sum[c];
}
