// The end of the backward pass: the slots of each triangle are added up in order, and the sums become gradients.
//
//   raster_reduce  a thread per triangle, in one view; what is summed over views is added to what the launches for the views
//                  before have left, as sums over views kept in registers would halve the occupancy. Triangles with more
//                  than kManySlots slots are added up by the whole warp. What is summed over triangles (one sigma, cameras)
//                  is left as a sum per view and block.
//   raster_gather  a thread per vertex adds the gradients of its corners, in order
// Definitions as in raster_tile.h, and CAMERAS (0, 1: gradients of cameras are wanted).
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
    const unsigned begin = inside ? pass.slot_begin[m] : 0, count = inside ? span_count(span_of(pass, m).word) : 0;
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

// What is summed over views begins with the first.
__device__ __forceinline__ void accumulate(float& sum, bool first, float value) { sum = (first ? 0.0f : sum) + value; }

// Gradients by what a triangle has beside its corners: opacity, softness, colours.
__device__ __forceinline__ void store_attributes(const RasterPass& pass, int triangle, long long m, bool first,
                                                 const float (&sums)[kStride]) {
    if (pass.grad_opacities) accumulate(pass.grad_opacities[triangle], first, sums[SlotLayout::kOpacity]);
    if (pass.grad_sigmas) accumulate(pass.grad_sigmas[triangle], first, sums[SlotLayout::kSigma]);
    if (pass.grad_flat) {
        float* row = pass.grad_flat + (pass.flat_per_view ? m : triangle) * FLAT;
        for (int c = 0; c < FLAT; ++c) accumulate(row[c], first || pass.flat_per_view, sums[SlotLayout::kFlat + c]);
    }
    if (pass.grad_corner_colors) {
        float* row = pass.grad_corner_colors + (pass.corner_per_view ? m : triangle) * 3 * CORNER;
        for (int j = 0; j < 3 * CORNER; ++j) accumulate(row[j], first || pass.corner_per_view, sums[kLayout.corner() + j]);
    }
}

// A triangle's corners in the world and in a view, and the gradients by the latter and by their projections.
struct Geometry {
    float world[9] = {}, view[9] = {}, grad_view[9] = {}, gx[3] = {}, gy[3] = {};

    __device__ __forceinline__ void evaluate(const RasterPass& pass, int view_index, int triangle,
                                             const float (&sums)[kStride]) {
        const PinholeCamera camera = load_camera(pass, view_index);
        const Distance distance = static_cast<Distance>(pass.distance);
        const SlotLayout layout = kLayout;
        Triangle2D<float> t;
        load_corners(pass, triangle, world);
        project_triangle(camera, pass.near_plane, distance, world, view, t);
        view_gradient(camera, distance, pass.freeze_inradius != 0, layout, sums, view, t, grad_view, gx, gy);
    }
};

}  // namespace etsplat

using namespace etsplat;

extern "C" __global__ void __launch_bounds__(128) raster_reduce(const __grid_constant__ RasterPass pass, int view) {
    __shared__ double part[kReduceBlock / kWarp];
    const int triangle = blockIdx.x * kReduceBlock + threadIdx.x;
    const long long m = static_cast<long long>(view) * pass.triangles + triangle;
    const long long block = static_cast<long long>(view) * gridDim.x + blockIdx.x;
    const bool inside = triangle < pass.triangles, first = view == 0;
    const bool drawn = inside && span_count(span_of(pass, m).word) > 0;
    float sums[kStride];
    sum_slots(pass, static_cast<int>(inside ? m : 0), inside, sums);
    if (inside) store_attributes(pass, triangle, m, first, sums);
    if (pass.sigma_sums) {
        const double sum = block_sum<kReduceBlock>(sums[SlotLayout::kSigma], part);
        if (threadIdx.x == 0) pass.sigma_sums[block] = sum;
    }
    if (!CAMERAS && !pass.grad_corners) return;
    Geometry geometry;
    if (drawn) geometry.evaluate(pass, view, triangle, sums);  // elsewhere not even the camera may be finite
    const PinholeCamera camera = load_camera(pass, view);  // again: to keep it costs registers
    if (inside && pass.grad_corners)
        for (int k = 0; k < 3; ++k) {
            float grad[3] = {};
            if (drawn) to_world_gradient(camera, geometry.grad_view + 3 * k, grad);
            for (int c = 0; c < 3; ++c) accumulate(pass.grad_corners[9ll * triangle + 3 * k + c], first, grad[c]);
        }
    if constexpr (CAMERAS)
        camera_gradient(geometry.world, geometry.view, geometry.grad_view, geometry.gx, geometry.gy,
                        [&](int number, const float* a, const float* b) {
                            float value = 0.0f;
                            for (int k = 0; k < 3; ++k) value += a[k] * b[k];
                            const double sum = block_sum<kReduceBlock>(drawn ? value : 0.0f, part);
                            if (threadIdx.x == 0) pass.camera_sums[block * kCameraGradients + number] = sum;
                        });
}

extern "C" __global__ void raster_gather(const float* grad_corners, const int* offsets, const int* corners, int vertices, float* grad_vertices) {
    const int vertex = blockIdx.x * blockDim.x + threadIdx.x;
    if (vertex >= vertices) return;
    float sum[3] = {};
    for (int i = offsets[vertex]; i < offsets[vertex + 1]; ++i)
        for (int c = 0; c < 3; ++c) sum[c] += grad_corners[3ll * corners[i] + c];
    for (int c = 0; c < 3; ++c) grad_vertices[3ll * vertex + c] = sum[c];
}
