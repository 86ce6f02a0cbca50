// How it is scheduled. Forward: (1) vertices are projected, and each face learns which of its edges are silhouettes, in
// parallel; (2) pixels are shaded in parallel (shading.cpp); (3) bands of rows look for pairs of neighbouring pixels with a
// silhouette between them, in parallel, each into a list of its own (36 bytes a blend, a few per silhouette pixel); (4) the
// lists are carried out in their order, on one thread: there are as many blends as silhouette pixels, a hundredth of the
// image where a mesh is welded, up to half of it where triangles are separate.
//
// Backward: blends hand their pixels' cotangents on, and move their edge's ends, on one thread; then comes that of shading.
// Nothing depends on which thread runs what.
#include "antialias.h"

#include <algorithm>

#include "math/antialias.h"
#include "math/triangle.h"
#include "parallel.h"
#include "prefetch.h"

namespace etsplat {
namespace {

constexpr int kAhead = 8;  // blends: the ends of their edges lie anywhere in memory

// Asks for what the ends of a blend are read from and added to.
void prefetch_ends(const Blend& blend, const float* vertices, const float* gradients) {
    for (const int64_t vertex : blend.vertex) {
        prefetch(vertices + 3 * vertex);
        prefetch(gradients + 3 * vertex);
    }
}

// Cotangents of the shaded pixels, and what the silhouettes' ends get from the weights.
void blend_backward(const std::vector<Blend>& blends, const ShadeInput& in, const AntialiasGradients& out) {
    const int32_t channels = in.channels;
    const PinholeCamera camera = pinhole(in.camera);
    const Blend* last = blends.data() + blends.size();
    for (const Blend& blend : blends) {
        if (out.into.vertices && last - &blend > kAhead) {
            prefetch_ends((&blend)[kAhead], in.mesh.vertices, out.into.vertices);
        }
        const int64_t to = static_cast<int64_t>(blend.to) * channels, from = static_cast<int64_t>(blend.from) * channels;
        double by_weight = 0.0;
        for (int32_t c = 0; c < channels; ++c) {
            const float g = out.color[to + c];
            by_weight += static_cast<double>(g) * (out.shaded[from + c] - out.shaded[to + c]);
            out.grad_shaded[from + c] += blend.weight * g;
            out.grad_shaded[to + c] -= blend.weight * g;
        }
        if (!out.into.vertices) continue;
        for (int end = 0; end < 2; ++end) {
            const float* p = in.mesh.vertices + 3 * static_cast<int64_t>(blend.vertex[end]);
            const double world[3] = {p[0], p[1], p[2]};
            double view[3], grad_view[3] = {0.0, 0.0, 0.0}, grad_world[3], x, y;
            to_camera(camera, world, view);
            project(camera, view, x, y);
            project_backward(camera, view, x, y, by_weight * blend.derivative[end][0],
                             by_weight * blend.derivative[end][1], grad_view);
            to_world_gradient(camera, grad_view, grad_world);
            float* into = out.into.vertices + 3 * static_cast<int64_t>(blend.vertex[end]);
            for (int i = 0; i < 3; ++i) into[i] += static_cast<float>(grad_world[i]);
        }
    }
}

void copy_image(const ShadeInput& in, const float* from, float* to) {
    const int64_t size = static_cast<int64_t>(in.camera.width) * in.camera.height * in.channels;
    parallel_for(size, 1 << 16, [&](int64_t begin, int64_t end) { std::copy(from + begin, from + end, to + begin); });
}

}  // namespace

std::shared_ptr<AntialiasState> antialias_forward(const AntialiasInput& input, float* shaded, float* color) {
    auto state = std::make_shared<AntialiasState>();
    const ShadeInput& in = input.shading;
    shade(in, shaded);
    state->blends = find_blends(input);
    copy_image(in, shaded, color);
    const int32_t channels = in.channels;
    for (const std::vector<Blend>& list : state->blends) {
        for (const Blend& blend : list) {
            const int64_t to = static_cast<int64_t>(blend.to) * channels, from = static_cast<int64_t>(blend.from) * channels;
            for (int32_t c = 0; c < channels; ++c) color[to + c] += blend.weight * (shaded[from + c] - shaded[to + c]);
        }
    }
    return state;
}

void antialias_behind(const AntialiasInput& nearest, const AntialiasInput& behind, const float* shaded, float* shaded_behind,
                      float* color) {
    const ShadeInput& in = behind.shading;
    shade(in, shaded_behind);
    copy_image(in, shaded_behind, color);
    const int32_t channels = in.channels;
    const int32_t* seen = nearest.shading.triangle;
    for (const std::vector<Blend>& list : find_blends_behind(nearest, behind)) {
        for (const Blend& blend : list) {
            const bool both = opaque_part(seen[blend.to]) == opaque_part(seen[blend.from]);
            const int64_t to = static_cast<int64_t>(blend.to) * channels, from = static_cast<int64_t>(blend.from) * channels;
            const float* other = (both ? shaded_behind : shaded) + from;
            for (int32_t c = 0; c < channels; ++c) color[to + c] += blend.weight * (other[c] - shaded_behind[to + c]);
        }
    }
}

void antialias_backward(const AntialiasState& state, const AntialiasInput& input, const AntialiasGradients& gradients) {
    copy_image(input.shading, gradients.color, gradients.grad_shaded);
    for (const std::vector<Blend>& list : state.blends) blend_backward(list, input.shading, gradients);
    shade_backward(input.shading, gradients.grad_shaded, gradients.into);
}

}  // namespace etsplat
