// Last stage of the backward pass. Triangles are reduced on their own (simd/reduce.h); here shared vertices gather from
// their corners in a fixed order, and sums over all triangles (shared sigma, camera) go over fixed chunks. Everything is
// added to the outputs.
#include <vector>

#include "array_scans.h"
#include "instruction_set.h"
#include "raster.h"

namespace etsplat {
namespace {

void gather_vertices(RasterState& state, float* out) {
    const int64_t count = 3 * state.call.num_vertices;
    state.vertex_gradients.resize(count);
    float* sums = state.vertex_gradients.data();
    sum_by_index(state.corner_gradients.data(), state.triangles.faces, 3 * state.call.num_triangles, state.call.num_vertices,
                 3, sums);
    parallel_for(count, 1 << 14, [=](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) out[i] += sums[i];
    });
}

void add_background(const RasterState& state, float* out) {
    const int channels = state.pass.channels();
    const int64_t tiles = int64_t{state.pass.tiles_x} * state.pass.tiles_y;
    std::vector<double> sums(static_cast<size_t>(channels), 0.0);
    for (int64_t tile = 0; tile < tiles; ++tile)
        for (int c = 0; c < channels; ++c) sums[static_cast<size_t>(c)] += state.tile_background[tile * channels + c];
    for (int c = 0; c < channels; ++c) out[c] += static_cast<float>(sums[static_cast<size_t>(c)]);
}

}  // namespace

void reduce_gradients(RasterState& state, const RasterGradients& gradients) {
    const RasterCall& call = state.call;
    const bool gather = call.faces && gradients.vertices;
    if (gather) state.corner_gradients.resize(9 * call.num_triangles);
    TrianglePass& pass = state.triangles;
    pass.want_camera = gradients.viewmat || gradients.K;
    pass.grad_corners = gather ? state.corner_gradients.data() : nullptr;
    pass.grad_vertices = gather ? nullptr : gradients.vertices;
    pass.grad_flat = gradients.flat_colors;
    pass.grad_corner_colors = gradients.corner_colors;
    pass.grad_opacities = gradients.opacities;
    pass.grad_sigmas = call.shared_sigma ? nullptr : gradients.sigmas;

    const TriangleKernels::Reduce reduce = active_triangle_kernels().reduce;
    std::vector<ChunkSums> chunks(static_cast<size_t>((pass.count + kTriangleChunk - 1) / kTriangleChunk));
    parallel_for(pass.count, kTriangleChunk, [&](int64_t begin, int64_t end) {
        thread_local Buffer<float> scratch;
        scratch.resize(TriangleKernels::reduce_scratch_size(state.pass.slot_layout));
        chunks[static_cast<size_t>(begin / kTriangleChunk)] = reduce(state.pass, pass, begin, end, scratch.data());
    });
    if (gather) gather_vertices(state, gradients.vertices);
    if (gradients.background) add_background(state, gradients.background);
    ChunkSums total{};
    for (const ChunkSums& chunk : chunks) {
        total.sigma += chunk.sigma;
        for (int k = 0; k < kCameraGradients; ++k) total.camera[k] += chunk.camera[k];
    }
    if (call.shared_sigma && gradients.sigmas) *gradients.sigmas += static_cast<float>(total.sigma);
    const auto add_camera = [&](float* out, int place, int number) {
        if (out) out[place] += static_cast<float>(total.camera[number]);
    };
    for (int k = 0; k < 12; ++k) add_camera(gradients.viewmat, k, k);
    for (int k = 0; k < 4; ++k) add_camera(gradients.K, kIntrinsicsPlace[k], 12 + k);
}

}  // namespace etsplat
