// Last stage of the backward pass: the slots of each triangle are added up in order, and the sums become gradients of
// vertices, colours, opacity and softness. Shared vertices gather from their corners in a fixed order; sums over all
// triangles (shared sigma, camera) go over fixed chunks. Everything is added to the outputs.
#include <vector>

#include "raster.h"

namespace etsplat {
namespace {

constexpr int64_t kChunk = 1024;  // fixed: the order of the sums must not depend on the number of threads

// Sums over all triangles of one chunk.
struct ChunkSums {
    double sigma = 0.0;
    double viewmat[12] = {};
};

struct Outputs {
    float* vertices;
    float* flat;
    float* corner;
    float* opacities;
    float* sigmas;
    bool camera;

    Outputs(const RasterState& state, const RasterGradients& g)
        : vertices(reinterpret_cast<float*>(g.vertices)),
          flat(reinterpret_cast<float*>(g.flat_colors)),
          corner(reinterpret_cast<float*>(g.corner_colors)),
          opacities(reinterpret_cast<float*>(g.opacities)),
          sigmas(state.call.shared_sigma ? nullptr : reinterpret_cast<float*>(g.sigmas)),
          camera(g.viewmat != 0) {}
};

// Sums the touched slots of a triangle into `sum`; returns whether there was any.
bool sum_slots(const RasterState& state, int64_t i, float* sum) {
    const int stride = state.pass.slot_layout.stride(), size = state.pass.slot_layout.size();
    bool any = false;
    for (int32_t s = state.slot_begin[i]; s < state.slot_begin[i + 1]; ++s) {
        if (!state.touched[s]) continue;
        const float* slot = state.slots.data() + int64_t{s} * stride;
        if (any)
            for (int j = 0; j < size; ++j) sum[j] += slot[j];
        else
            for (int j = 0; j < size; ++j) sum[j] = slot[j];
        any = true;
    }
    return any;
}

// Camera-space gradient (3, 3) of the vertices of one triangle.
void view_gradient(const RasterState& state, const float* sum, int64_t i, const float* view, const Triangle2D& t,
                   float* grad_view) {
    const SlotLayout& layout = state.pass.slot_layout;
    float gx[3] = {}, gy[3] = {};
    distance_backward(t, static_cast<Distance>(state.call.distance), state.call.freeze_incentre,
                      sum + SlotLayout::kMoment, sum + SlotLayout::kMomentX, sum + SlotLayout::kMomentY, gx, gy);
    for (int k = 0; k < 9; ++k) grad_view[k] = 0.0f;
    if (layout.attributes) {
        const float* moment = sum + layout.barycentric();
        const AttributeRecord& record = state.attributes[i];
        float a_at_q[3];
        for (int m = 0; m < 3; ++m)
            a_at_q[m] = 1.0f / 3.0f + record.ax[m] * record.offset_x + record.ay[m] * record.offset_y;
        barycentric_backward(t, a_at_q, moment, moment + 3, moment + 6, gx, gy);
        for (int k = 0; k < 3; ++k)
            grad_view[3 * k + 2] -= sum[layout.inverse_z() + k] * record.inverse_z[k] * record.inverse_z[k];
    }
    if (layout.centroid_z)
        for (int k = 0; k < 3; ++k) grad_view[3 * k + 2] += sum[layout.depth()] / 3.0f;
    for (int k = 0; k < 3; ++k)
        project_backward(state.camera, view + 3 * k, t.x[k], t.y[k], gx[k], gy[k], grad_view + 3 * k);
}

void add_camera_gradient(const RasterState& state, int64_t i, const float* grad_view, ChunkSums& sums) {
    const auto* vertices = reinterpret_cast<const float*>(state.call.vertices);
    const auto* faces = reinterpret_cast<const int32_t*>(state.call.faces);
    for (int k = 0; k < 3; ++k) {
        const float* v = vertices + 3 * (faces ? int64_t{faces[3 * i + k]} : 3 * i + k);
        for (int row = 0; row < 3; ++row) {
            for (int col = 0; col < 3; ++col) sums.viewmat[4 * row + col] += double{grad_view[3 * k + row]} * v[col];
            sums.viewmat[4 * row + 3] += grad_view[3 * k + row];
        }
    }
}

void reduce_triangle(RasterState& state, const Outputs& out, int64_t i, float* sum, float* corner_gradient, ChunkSums& sums) {
    const RasterCall& call = state.call;
    const SlotLayout& layout = state.pass.slot_layout;
    if (!sum_slots(state, i, sum)) {
        if (corner_gradient)
            for (int k = 0; k < 9; ++k) corner_gradient[k] = 0.0f;
        return;
    }
    if (out.flat)
        for (int c = 0; c < call.flat_channels; ++c) out.flat[i * call.flat_channels + c] += sum[SlotLayout::kFlat + c];
    if (out.corner)
        for (int c = 0; c < 3 * call.corner_channels; ++c)
            out.corner[i * 3 * call.corner_channels + c] += sum[layout.corner() + c];
    if (out.opacities) out.opacities[i] += sum[SlotLayout::kOpacity];
    if (out.sigmas) out.sigmas[i] += sum[SlotLayout::kSigma];
    sums.sigma += sum[SlotLayout::kSigma];
    if (!out.vertices && !out.camera) return;
    float view[9], grad_view[9];
    Triangle2D t;
    load_triangle(state, i, view, t);
    view_gradient(state, sum, i, view, t, grad_view);
    if (out.camera) add_camera_gradient(state, i, grad_view, sums);
    if (!out.vertices) return;
    float world[9];
    for (int k = 0; k < 3; ++k) to_world_gradient(state.camera, grad_view + 3 * k, world + 3 * k);
    for (int k = 0; k < 9; ++k) {
        if (corner_gradient)
            corner_gradient[k] = world[k];
        else
            out.vertices[9 * i + k] += world[k];
    }
}

void gather_vertices(const RasterState& state, const RasterGradients& gradients) {
    const auto* offsets = reinterpret_cast<const int32_t*>(gradients.corner_offsets);
    const auto* corners = reinterpret_cast<const int32_t*>(gradients.corner_indices);
    auto* out = reinterpret_cast<float*>(gradients.vertices);
    parallel_for(state.call.num_vertices, 4096, [&](int64_t begin, int64_t end) {
        for (int64_t v = begin; v < end; ++v) {
            float sum[3] = {};
            for (int32_t c = offsets[v]; c < offsets[v + 1]; ++c)
                for (int k = 0; k < 3; ++k) sum[k] += state.corner_gradients[int64_t{3} * corners[c] + k];
            for (int k = 0; k < 3; ++k) out[3 * v + k] += sum[k];
        }
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
    const Outputs out(state, gradients);
    const bool gather = call.faces && out.vertices;
    if (gather) state.corner_gradients.resize(9 * call.num_triangles);
    const int64_t n = call.num_triangles;
    std::vector<ChunkSums> chunks(static_cast<size_t>((n + kChunk - 1) / kChunk));
    parallel_for(static_cast<int64_t>(chunks.size()), 1, [&](int64_t first, int64_t last) {
        std::vector<float> sum(static_cast<size_t>(state.pass.slot_layout.stride()));
        for (int64_t chunk = first; chunk < last; ++chunk)
            for (int64_t i = chunk * kChunk; i < n && i < (chunk + 1) * kChunk; ++i)
                reduce_triangle(state, out, i, sum.data(), gather ? state.corner_gradients.data() + 9 * i : nullptr,
                                chunks[static_cast<size_t>(chunk)]);
    });
    if (gather) gather_vertices(state, gradients);
    if (gradients.background) add_background(state, reinterpret_cast<float*>(gradients.background));
    ChunkSums total;
    for (const ChunkSums& chunk : chunks) {
        total.sigma += chunk.sigma;
        for (int k = 0; k < 12; ++k) total.viewmat[k] += chunk.viewmat[k];
    }
    if (call.shared_sigma && gradients.sigmas) *reinterpret_cast<float*>(gradients.sigmas) += static_cast<float>(total.sigma);
    if (out.camera)
        for (int k = 0; k < 12; ++k) reinterpret_cast<float*>(gradients.viewmat)[k] += static_cast<float>(total.viewmat[k]);
}

}  // namespace etsplat
