// Forward and backward passes of one view as sequences of stages.
#include "raster.h"

#include <limits>
#include <mutex>
#include <stdexcept>
#include <vector>

#include "forking.h"
#include "instruction_set.h"

namespace etsplat {
namespace {

// States are recycled: their buffers are warm, and a step of training makes no large allocation.
std::mutex free_mutex;
const LockedWhileForking<free_mutex> whole_in_children;
auto& free_states = *new std::vector<std::unique_ptr<RasterState>>;  // threads may still draw while the process ends
constexpr size_t kMostFreeStates = 2;

std::shared_ptr<RasterState> acquire_state() {
    std::unique_ptr<RasterState> state;
    {
        std::lock_guard lock(free_mutex);
        if (!free_states.empty()) {
            state = std::move(free_states.back());
            free_states.pop_back();
        }
    }
    if (!state) state = std::make_unique<RasterState>();
    return {state.release(), [](RasterState* done) {
                std::unique_ptr<RasterState> owned(done);
                std::lock_guard lock(free_mutex);
                if (free_states.size() < kMostFreeStates) free_states.push_back(std::move(owned));
            }};
}

PinholeCamera camera_of(const RasterCall& call) {
    return pinhole_camera(call.viewmat, call.K);
}

void fill_pass(RasterState& state) {
    const RasterCall& call = state.call;
    RasterPass pass;
    pass.width = call.width;
    pass.height = call.height;
    pass.tiles_x = (call.width + kTile - 1) / kTile;
    pass.tiles_y = (call.height + kTile - 1) / kTile;
    pass.kernel = call.kernel;
    pass.flat_channels = call.flat_channels;
    pass.corner_channels = call.corner_channels;
    pass.want_distortion = call.distortion != nullptr;
    pass.want_median = call.median_triangle != nullptr;
    if (pass.want_distortion)
        pass.distortion_depth = call.centroid_depth ? DistortionDepth::kCentroid : DistortionDepth::kPlane;
    // With the cut-offs off, too: where alpha is 0 x^(2/sigma) may have overflowed, and the backward divides by 1 - alpha.
    pass.alpha_min = vmax(call.alpha_min, std::numeric_limits<float>::min());
    pass.alpha_max = vmin(call.alpha_max, 1.0f - 1e-6f);
    pass.transmittance_min = call.transmittance_min;
    pass.distortion_near = call.distortion_near;
    pass.distortion_far = call.distortion_far;
    pass.slot_layout = {call.flat_channels, call.corner_channels, pass.distortion_depth};
    pass.attributes = pass.slot_layout.attributes();
    state.pass = pass;
}

void fill_triangles(RasterState& state) {
    const RasterCall& call = state.call;
    TrianglePass pass;
    pass.count = call.num_triangles;
    pass.camera = camera_of(call);
    pass.distance = static_cast<Distance>(call.distance);
    pass.freeze_inradius = call.freeze_inradius;
    pass.shared_sigma = call.shared_sigma;
    pass.near_plane = call.near_plane;
    pass.support_alpha = call.alpha_min;
    pass.x_max = call.x_max;
    state.records.resize(pass.count);
    state.attributes.resize(
        state.pass.attributes || state.pass.distortion_depth != DistortionDepth::kNone ? pass.count : 0);
    state.keys.resize(pass.count);
    state.spans.resize(pass.count);
    pass.records = state.records.data();
    pass.attributes = state.attributes.size() > 0 ? state.attributes.data() : nullptr;
    pass.keys = state.keys.data();
    pass.spans = state.spans.data();
    state.triangles = pass;
}

// Where the arrays of `call` lie: the backward pass may be handed them elsewhere than the forward pass found them.
void bind_arrays(RasterState& state, const RasterCall& call) {
    RasterPass& pass = state.pass;
    pass.kernel_table = call.kernel_table;
    pass.flat_colors = call.flat_colors;
    pass.corner_colors = call.corner_colors;
    pass.background = call.background;
    pass.color = call.color;
    pass.alpha = call.alpha;
    pass.distortion = call.distortion;
    pass.distortion_totals = call.distortion_totals;
    pass.median_triangle = call.median_triangle;
    TrianglePass& triangles = state.triangles;
    triangles.vertices = call.vertices;
    triangles.faces = call.faces;
    triangles.opacities = call.opacities;
    triangles.sigmas = call.sigmas;
    triangles.screen_size = call.screen_size;
    triangles.inradius = call.inradius;
    triangles.visible = call.visible;
}

void project_triangles(RasterState& state, const TriangleKernels& kernels) {
    const TriangleKernels::Project project = kernels.project[state.pass.kernel];
    const int64_t n = state.triangles.count;
    state.chunk_totals.resize(static_cast<size_t>((n + kTriangleChunk - 1) / kTriangleChunk));
    parallel_for(n, kTriangleChunk, [&](int64_t begin, int64_t end) {
        state.chunk_totals[static_cast<size_t>(begin / kTriangleChunk)] = project(state.pass, state.triangles, begin, end);
    });
}

void run_tiles(RasterState& state, const TileFunction function) {
    const RasterPass& pass = state.pass;
    // a little scratch per range of tiles: ranges are few enough to keep it all
    constexpr int64_t kRange = 4;
    const int64_t tiles = int64_t{pass.tiles_x} * pass.tiles_y;
    parallel_for(tiles, kRange, [&](int64_t begin, int64_t end) {
        thread_local Buffer<float> scratch;
        scratch.resize(pass.scratch_size());
        for (int64_t tile = begin; tile < end; ++tile) function(pass, static_cast<int>(tile), scratch.data());
    });
}

void reduce_weights(RasterState& state) {
    auto* out = state.call.max_weight;
    parallel_for(state.call.num_triangles, 4096, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) {
            float largest = 0.0f;
            for (int32_t s = state.slot_begin[i]; s < state.slot_begin[i + 1]; ++s)
                largest = vmax(largest, state.slot_weight[s]);
            out[i] = largest;
        }
    });
}

}  // namespace

int64_t RasterState::bytes() const {
    return records.bytes() + attributes.bytes() + keys.bytes() + keys_swap.bytes() + order.bytes() + order_swap.bytes() +
           spans.bytes() + slot_begin.bytes() + slot_tile.bytes() + histogram.bytes() + tile_begin.bytes() +
           entries.bytes() + hits.bytes() + slot_weight.bytes() + slots.bytes() + corner_gradients.bytes() +
           vertex_gradients.bytes() + tile_background.bytes() + touched.bytes();
}

std::shared_ptr<RasterState> raster_forward(const RasterCall& call) {
    auto state = acquire_state();
    StageClock clock(state->stages);
    state->call = call;
    fill_pass(*state);
    fill_triangles(*state);
    bind_arrays(*state, call);
    RasterPass& pass = state->pass;
    const TriangleKernels& kernels = active_triangle_kernels();
    project_triangles(*state, kernels);
    clock.lap(Stage::kProject);
    bin_triangles(*state, kernels);
    clock.lap(Stage::kBin);
    pass.records = state->records.data();
    pass.attribute_records = state->attributes.data();
    pass.tile_begin = state->tile_begin.data();
    pass.entries = state->entries.data();
    if (call.keep_for_backward) {
        state->hits.resize(state->num_slots);
        pass.hits = state->hits.data();
        state->tile_done.resize(int64_t{pass.tiles_x} * pass.tiles_y);
        pass.tile_done = state->tile_done.data();
    }
    if (call.max_weight) {
        state->slot_weight.resize(state->num_slots);
        state->slot_weight.fill_zero();
        pass.slot_weight = state->slot_weight.data();
    }
    run_tiles(*state, active_raster_kernels().forward[pass.kernel][static_cast<int>(pass.shape())]);
    if (call.max_weight) reduce_weights(*state);
    clock.lap(Stage::kForward);
    return state;
}

void raster_backward(RasterState& state, const RasterCall& call, const RasterGradients& gradients) {
    StageClock clock(state.stages);
    RasterPass& pass = state.pass;
    if (!state.call.keep_for_backward) throw std::logic_error("rasterize: this render was made without keep_for_backward");
    bind_arrays(state, call);
    pass.grad_color = gradients.grad_color;
    pass.grad_alpha = gradients.grad_alpha;
    pass.grad_distortion = gradients.grad_distortion;
    state.slots.resize(state.num_slots * pass.slot_layout.stride());
    state.touched.resize(state.num_slots);
    state.touched.fill_zero();
    pass.slots = state.slots.data();
    pass.touched = state.touched.data();
    pass.tile_background = nullptr;
    if (gradients.background) {
        state.tile_background.resize(int64_t{pass.tiles_x} * pass.tiles_y * pass.channels());
        pass.tile_background = state.tile_background.data();
    }
    run_tiles(state, active_raster_kernels().backward[pass.kernel][static_cast<int>(pass.shape())]);
    clock.lap(Stage::kBackward);
    reduce_gradients(state, gradients);
    clock.lap(Stage::kReduce);
}

}  // namespace etsplat
