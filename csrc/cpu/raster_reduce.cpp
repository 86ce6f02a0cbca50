// Last stage of the backward pass. Triangles are reduced on their own (simd/reduce.h); here shared vertices gather from
// their corners in a fixed order, and sums over all triangles (shared sigma, camera) go over fixed chunks. Everything is
// added to the outputs.
#include <algorithm>
#include <atomic>
#include <mutex>
#include <optional>
#include <vector>

#include "array_scans.h"
#include "instruction_set.h"
#include "raster.h"

namespace etsplat {
namespace {

// Sums of the gradients of corners at each vertex, in the order of the corners.
class VertexSums {
public:
    VertexSums(RasterState& state, int64_t chunks)
        : values_(state.corner_gradients.data()), faces_(state.triangles.faces), corners_(3 * state.call.num_triangles),
          vertices_(state.call.num_vertices), ready_(static_cast<size_t>(along_ ? chunks : 0)) {
        state.vertex_gradients.resize(3 * vertices_);
        sums_ = state.vertex_gradients.data();
        if (along_) zero_floats(sums_, 3 * vertices_);
    }

    // To be called when a chunk of triangles is reduced: adds it and all that wait for it, unless another thread is at that.
    void reduced(int64_t chunk) {
        if (!along_) return;
        ready_[static_cast<size_t>(chunk)].store(true, std::memory_order_release);
        if (const std::unique_lock lock(adding_, std::try_to_lock); lock) add_ready();
    }

    // When all are.
    void add_to(float* out) {
        if (along_)
            add_ready();
        else
            sum_by_index(values_, faces_, corners_, vertices_, 3, sums_);
        parallel_for(3 * vertices_, 1 << 14, [=, sums = sums_](int64_t begin, int64_t end) {
            for (int64_t i = begin; i < end; ++i) out[i] += sums[i];
        });
    }

private:
    void add_ready() {
        for (; next_ < ready_.size() && ready_[next_].load(std::memory_order_acquire); ++next_) {
            const int64_t first = 3 * kTriangleChunk * static_cast<int64_t>(next_);
            add_by_index(values_ + 3 * first, faces_ + first, std::min(3 * kTriangleChunk, corners_ - first), 3, sums_);
        }
    }

    // One thread at a time adds while the others reduce, which takes six times as long: more than that would wait for it.
    const bool along_ = num_threads() > 1 && num_threads() <= 6;
    const float* values_;
    const int32_t* faces_;
    int64_t corners_, vertices_;
    float* sums_ = nullptr;
    std::vector<std::atomic<bool>> ready_;  // chunks
    std::mutex adding_;
    size_t next_ = 0;  // chunk to be added
};

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
    std::optional<VertexSums> shared;
    if (gather) shared.emplace(state, static_cast<int64_t>(chunks.size()));
    parallel_for(pass.count, kTriangleChunk, [&](int64_t begin, int64_t end) {
        thread_local Buffer<float> scratch;
        scratch.resize(TriangleKernels::reduce_scratch_size(state.pass.slot_layout));
        const int64_t chunk = begin / kTriangleChunk;
        chunks[static_cast<size_t>(chunk)] = reduce(state.pass, pass, begin, end, scratch.data());
        if (shared) shared->reduced(chunk);
    });
    if (shared) shared->add_to(gradients.vertices);
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
