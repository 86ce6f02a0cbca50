// Shading and silhouette antialiasing of what the z-buffer found in one view (csrc/math/antialias.h), with gradients.
//
// Forward: points projected, silhouette edges marked, pixels shaded; then each pixel looks at its four pairs of neighbours
// and takes what their silhouettes give it, so that nothing is scattered. Backward: each pixel gathers its cotangent in
// the same way; then cotangents go to colours and corners, many pixels to a place, as fixed-point sums (fixed_sums.h):
// the same bits in every run. Each pair is evaluated by both its pixels, and few pairs have anything between them: some 50
// bytes a pixel bound the forward; atomics in L2, 3 a pixel for colours, bound the backward. The background has few numbers for
// many pixels: it is summed by blocks.
#include "cuda/block_sum.h"
#include "cuda/shading.h"
#include "math/texture.h"

using namespace etsplat;

struct AntialiasView {
    ShadedView shaded;
    const float* depth;
    const int *pair_offsets, *paired_faces;
    float near_plane;
};

struct ScreenPoint {
    double at[2];
    int drawn;
};

extern "C" __global__ void antialias_points(AntialiasView view, ScreenPoint* points) {
    const long long v = thread_index();
    if (v >= view.shaded.num_vertices) return;
    const float* p = view.shaded.vertices + 3 * v;
    const double world[3] = {p[0], p[1], p[2]};
    double seen[3];
    ScreenPoint q;
    const PinholeCamera camera = camera_of(view.shaded);
    to_camera(camera, world, seen);
    project(camera, seen, q.at[0], q.at[1]);
    q.drawn = seen[2] > static_cast<double>(view.near_plane) && q.at[0] - q.at[0] == 0.0 && q.at[1] - q.at[1] == 0.0;
    points[v] = q;
}

// Bit k of a face: its edge from corner k to k + 1 is a silhouette, that is, no face across it lies on the other side.
extern "C" __global__ void antialias_silhouettes(AntialiasView view, const ScreenPoint* points, unsigned char* bits) {
    const long long f = thread_index();
    if (f >= view.shaded.num_faces) return;
    const int* own = view.shaded.faces + 3 * f;
    int found = 7;
    for (int i = view.pair_offsets[f]; i < view.pair_offsets[f + 1]; ++i) {
        const int* other = view.shaded.faces + 3 * static_cast<long long>(view.paired_faces[i]);
        if (!points[other[0]].drawn || !points[other[1]].drawn || !points[other[2]].drawn) continue;
        for (int k = 0; k < 3; ++k) {
            const int a = own[k], b = own[(k + 1) % 3];
            for (int j = 0; j < 3; ++j) {
                const int p = other[j], q = other[(j + 1) % 3];
                if ((p != a || q != b) && (p != b || q != a)) continue;
                const double here = side_of(points[a].at, points[b].at, points[own[(k + 2) % 3]].at);
                const double there = side_of(points[a].at, points[b].at, points[other[(j + 2) % 3]].at);
                if (here * there < 0.0) found &= ~(1 << k);
            }
        }
    }
    bits[f] = static_cast<unsigned char>(found);
}

extern "C" __global__ void shade_forward(ShadedView view, float* image) {
    const long long p = thread_index();
    if (p < pixel_count(view)) shade(view, p, image + p * view.channels);
}

// Colours of pixels get the cotangents of those that show a triangle.
extern "C" __global__ void shade_pixels(ShadedView view, const float* grad_shaded, float* grad_colors) {
    const long long p = thread_index();
    if (p >= pixel_count(view)) return;
    for (int c = 0; c < view.channels; ++c) {
        grad_colors[p * view.channels + c] = view.triangle[p] < 0 ? 0.0f : grad_shaded[p * view.channels + c];
    }
}

extern "C" __global__ void shade_measure(ShadedView view, const float* grad_shaded, Targets targets) {
    const long long p = thread_index();
    Collector<true> into(targets);
    if (p < pixel_count(view)) collect_shaded(view, p, grad_shaded + p * view.channels, into);
    for (int i = 0; i < kTargets; ++i) record_largest(into.magnitudes[i], targets.largest + i);
}

extern "C" __global__ void shade_scatter(ShadedView view, const float* grad_shaded, Targets targets) {
    const long long p = thread_index();
    Collector<false> into(targets);
    if (p < pixel_count(view)) collect_shaded(view, p, grad_shaded + p * view.channels, into);
}

// The view's colours are texture coordinates of corners, in a texture of so many texels.
extern "C" __global__ void texture_detail(ShadedView view, const float* depth, int width, int height, float* lod) {
    const long long p = thread_index();
    if (p >= pixel_count(view)) return;
    const long long face = view.triangle[p];
    lod[p] = 0.0f;
    if (face < 0) return;
    const PinholeCamera camera = camera_of(view);
    lod[p] = level_of_detail(inverse_of(view, camera, p), ray_turn(camera), view.barycentrics + 3 * p,
                             view.colors + 6 * face, depth[p], width, height);
}

struct Scene {
    AntialiasView view;
    const ScreenPoint* points;
    const unsigned char* silhouettes;
};

struct PairBlend {
    long long to, from;  // pixels
    int ends[2];
    SilhouetteBlend blend;
};

// The pair of the pixel (x, y) and its neighbour at the right (axis 0) or below (axis 1).
__device__ bool find_pair(const Scene& scene, int x, int y, int axis, PairBlend& pair) {
    const ShadedView& view = scene.view.shaded;
    const float* depth = scene.view.depth;
    const bool exists = x >= 0 && y >= 0 && x + (axis == 0) < view.width && y + (axis == 1) < view.height;
    if (!exists) return false;
    const long long first = static_cast<long long>(y) * view.width + x, second = first + (axis == 0 ? 1 : view.width);
    const int first_face = view.triangle[first], second_face = view.triangle[second];
    if (first_face == second_face) return false;
    const bool forward = second_face < 0 || (first_face >= 0 && depth[first] <= depth[second]);
    const long long nearer = forward ? first_face : second_face;
    const int silhouettes = scene.silhouettes[nearer];
    const double along = (axis == 0 ? x : y) + (forward ? 0.5 : 1.5), across = (axis == 0 ? y : x) + 0.5;
#pragma unroll 1  // one in a hundred pixels gets here
    for (int k = 0; k < 3; ++k) {
        if (!(silhouettes >> k & 1)) continue;
        pair.ends[0] = view.faces[3 * nearer + k];
        pair.ends[1] = view.faces[3 * nearer + (k + 1) % 3];
        const double *a = scene.points[pair.ends[0]].at, *b = scene.points[pair.ends[1]].at;
        if (!silhouette_blend(a, b, axis, along, across, forward, pair.blend)) continue;
        pair.to = pair.blend.into_second ? second : first;
        pair.from = pair.blend.into_second ? first : second;
        return true;
    }
    return false;
}

// The pairs of pixel p, in the order of their first pixels: above, left, right, below.
template <class Visit>
__device__ void for_each_pair(const Scene& scene, long long p, const Visit& visit) {
    const int x = static_cast<int>(p % scene.view.shaded.width), y = static_cast<int>(p / scene.view.shaded.width);
#pragma unroll 1
    for (int side = 0; side < 4; ++side) {
        PairBlend pair;
        const int axis = side == 0 || side == 3 ? 1 : 0;
        if (find_pair(scene, side == 1 ? x - 1 : x, side == 0 ? y - 1 : y, axis, pair)) visit(pair);
    }
}

extern "C" __global__ void antialias_blend(Scene scene, const float* shaded, float* image) {
    const long long p = thread_index();
    if (p >= pixel_count(scene.view.shaded)) return;
    const int channels = scene.view.shaded.channels;
    for (int c = 0; c < channels; ++c) image[p * channels + c] = shaded[p * channels + c];
    for_each_pair(scene, p, [&](const PairBlend& pair) {
        if (pair.to != p) return;
        for (int c = 0; c < channels; ++c) {
            image[p * channels + c] += pair.blend.weight * (shaded[pair.from * channels + c] - shaded[p * channels + c]);
        }
    });
}

// Cotangent of the shaded image from that of the image.
extern "C" __global__ void antialias_unblend(Scene scene, const float* grad_image, float* grad_shaded) {
    const long long p = thread_index();
    if (p >= pixel_count(scene.view.shaded)) return;
    const int channels = scene.view.shaded.channels;
    for (int c = 0; c < channels; ++c) grad_shaded[p * channels + c] = grad_image[p * channels + c];
    for_each_pair(scene, p, [&](const PairBlend& pair) {
        for (int c = 0; c < channels; ++c) {
            const float moved = pair.blend.weight * grad_image[pair.to * channels + c];
            grad_shaded[p * channels + c] += pair.to == p ? -moved : moved;
        }
    });
}

// The weight of a pair's blend moves the ends of its silhouette.
template <class Into>
__device__ void collect_silhouette(const Scene& scene, const PairBlend& pair, int axis, const float* shaded,
                                   const float* grad_image, Into& into) {
    const int channels = scene.view.shaded.channels;
    double by_weight = 0.0;
    for (int c = 0; c < channels; ++c) {
        const float step = shaded[pair.from * channels + c] - shaded[pair.to * channels + c];
        by_weight += static_cast<double>(grad_image[pair.to * channels + c]) * step;
    }
    const PinholeCamera camera = camera_of(scene.view.shaded);
#pragma unroll  // so that no index is a variable
    for (int end = 0; end < 2; ++end) {
        const float* p = scene.view.shaded.vertices + 3 * static_cast<long long>(pair.ends[end]);
        const double world[3] = {p[0], p[1], p[2]};
        double seen[3], grad_seen[3] = {0.0, 0.0, 0.0}, grad_world[3], x, y;
        to_camera(camera, world, seen);
        project(camera, seen, x, y);
        const float by_along = pair.blend.by_along[end], by_across = pair.blend.by_across[end];
        project_backward(camera, seen, x, y, by_weight * (axis == 0 ? by_along : by_across),
                         by_weight * (axis == 0 ? by_across : by_along), grad_seen);
        to_world_gradient(camera, grad_seen, grad_world);
        into.vertex(pair.ends[end], grad_world);
    }
}

template <class Into>
__device__ void collect(const Scene& scene, long long p, const float* shaded, const float* grad_image,
                        const float* grad_shaded, Into& into) {
    const ShadedView& view = scene.view.shaded;
    if (into.targets.vertices) {  // the pairs that begin here
        const int x = static_cast<int>(p % view.width), y = static_cast<int>(p / view.width);
        PairBlend pair;
        for (int axis = 0; axis < 2; ++axis) {
            if (find_pair(scene, x, y, axis, pair)) collect_silhouette(scene, pair, axis, shaded, grad_image, into);
        }
    }
    collect_shaded(view, p, grad_shaded + p * view.channels, into);
}

extern "C" __global__ void antialias_measure(Scene scene, const float* shaded, const float* grad_image,
                                             const float* grad_shaded, Targets targets) {
    const long long p = thread_index();
    Collector<true> into(targets);
    if (p < pixel_count(scene.view.shaded)) collect(scene, p, shaded, grad_image, grad_shaded, into);
    for (int i = 0; i < kTargets; ++i) record_largest(into.magnitudes[i], targets.largest + i);
}

extern "C" __global__ void antialias_scatter(Scene scene, const float* shaded, const float* grad_image,
                                             const float* grad_shaded, Targets targets) {
    const long long p = thread_index();
    Collector<false> into(targets);
    if (p < pixel_count(scene.view.shaded)) collect(scene, p, shaded, grad_image, grad_shaded, into);
}

// Adds `count` sums to a gradient.
extern "C" __global__ void antialias_finish(const FixedSum* sums, const unsigned* largest, long long count,
                                            float* gradient) {
    const long long i = thread_index();
    if (i < count) gradient[i] += from_fixed(sums[i], *largest);
}

// The pixels of a block that show no triangle: a row of sums (channels) for each block.
extern "C" __global__ void background_sums(ShadedView view, const float* grad_shaded, double* sums) {
    __shared__ double scratch[kThreads / kWarp];
    const long long p = thread_index();
    const bool behind = p < pixel_count(view) && view.triangle[p] < 0;
    double* row = sums + static_cast<long long>(blockIdx.x) * view.channels;
    if (!__syncthreads_or(behind)) {
        for (int c = threadIdx.x; c < view.channels; c += kThreads) row[c] = 0.0;
        return;
    }
    for (int c = 0; c < view.channels; ++c) {
        const double sum = block_sum<kThreads>(behind ? grad_shaded[p * view.channels + c] : 0.0, scratch);
        if (threadIdx.x == 0) row[c] = sum;
    }
}

// A block for each channel.
extern "C" __global__ void background_gradient(const double* sums, long long rows, int channels, float* gradient) {
    __shared__ double scratch[kThreads / kWarp];
    const int channel = blockIdx.x;
    const double sum = sum_of_array<kThreads>(sums + channel, rows, channels, scratch);
    if (threadIdx.x == 0) gradient[channel] = static_cast<float>(sum);
}
