// Colours of pixels from what the z-buffer found in one view (csrc/math/antialias.h), and where their cotangents go: many
// pixels to a place, as fixed-point sums (fixed_sums.h), the same bits in every run.
#pragma once

#include "cuda/fixed_sums.h"
#include "math/antialias.h"
#include "math/triangle.h"

namespace etsplat {

constexpr int kThreads = kBlock;

// `colors` are (num_faces), (num_vertices), (num_faces, 3) or (height, width) times channels, as colors_of says; a
// background of null is 0.
struct ShadedView {
    const float *vertices, *viewmat, *K, *barycentrics, *colors, *background;
    const int *faces, *triangle;
    long long num_vertices, num_faces;
    int width, height, channels, colors_of;
};

__device__ __forceinline__ PinholeCamera camera_of(const ShadedView& view) {
    return pinhole_camera(view.viewmat, view.K);
}

__device__ __forceinline__ long long thread_index() {
    return static_cast<long long>(blockIdx.x) * kThreads + threadIdx.x;
}
__device__ __forceinline__ long long pixel_count(const ShadedView& view) {
    return static_cast<long long>(view.width) * view.height;
}

__device__ __forceinline__ bool has_colors_of(const ShadedView& view, ColorsOf kind) {
    return view.colors_of == static_cast<int>(kind);
}

// Where the colour of a corner lies.
__device__ __forceinline__ long long corner_color(const ShadedView& view, long long face, int corner) {
    const long long row = has_colors_of(view, ColorsOf::kCorners) ? 3 * face + corner : view.faces[3 * face + corner];
    return row * view.channels;
}

__device__ __forceinline__ void shade(const ShadedView& view, long long p, float* out) {
    const long long face = view.triangle[p];
    for (int c = 0; c < view.channels; ++c) {
        if (face < 0) {
            out[c] = view.background ? view.background[c] : 0.0f;
        } else if (has_colors_of(view, ColorsOf::kFaces)) {
            out[c] = view.colors[face * view.channels + c];
        } else if (has_colors_of(view, ColorsOf::kPixels)) {
            out[c] = view.colors[p * view.channels + c];
        } else {
            const float* b = view.barycentrics + 3 * p;
            float color[3];
            for (int i = 0; i < 3; ++i) color[i] = view.colors[corner_color(view, face, i) + c];
            out[c] = b[0] * color[0] + b[1] * color[1] + b[2] * color[2];
        }
    }
}

// The corners of the face of pixel p, relative to the camera's centre, turned around.
__device__ __forceinline__ ViewInverse<double> inverse_of(const ShadedView& view, const PinholeCamera& camera,
                                                          long long p) {
    const int* k = view.faces + 3 * static_cast<long long>(view.triangle[p]);
    Vector3<double> corner[3];
    for (int i = 0; i < 3; ++i) {
        double relative[3];
        for (int j = 0; j < 3; ++j) {
            relative[j] = view.vertices[3 * static_cast<long long>(k[i]) + j];
            for (int r = 0; r < 3; ++r) {
                relative[j] += static_cast<double>(camera.rotation[3 * r + j]) * camera.translation[r];
            }
        }
        corner[i] = {relative[0], relative[1], relative[2]};
    }
    return view_inverse(corner);
}

// Where gradients go, null if nobody wants them; `largest` has a number for each of the two.
struct Targets {
    FixedSum *vertices, *colors;
    unsigned* largest;
};
constexpr int kTargets = 2;

// Adds (or, if Measure, looks at) what one pixel gives to the targets.
template <bool Measure>
struct Collector {
    const Targets& targets;
    float magnitudes[kTargets] = {};
    double scales[kTargets] = {};

    __device__ explicit Collector(const Targets& t) : targets(t) {
        for (int i = 0; i < kTargets && !Measure; ++i) scales[i] = fixed_scale(t.largest[i]);
    }
    __device__ void add(int target, FixedSum* sums, long long index, double value) {
        if (Measure) {
            const float magnitude = static_cast<float>(value < 0.0 ? -value : value);
            if (!(magnitude <= magnitudes[target])) magnitudes[target] = magnitude;  // also a NaN
        } else {
            add_fixed(sums + index, value, scales[target]);
        }
    }
    __device__ void vertex(long long v, const double* gradient) {
        for (int i = 0; i < 3; ++i) add(0, targets.vertices, 3 * v + i, gradient[i]);
    }
    __device__ void color(long long index, double value) {
        if (targets.colors) add(1, targets.colors, index, value);
    }
};

// An interpolated colour gives to the colours of three vertices, and to their positions.
template <class Into>
__device__ void collect_interpolated(const ShadedView& view, long long p, const float* g, Into& into) {
    const int* k = view.faces + 3 * static_cast<long long>(view.triangle[p]);
    double b[3], cotangent[3] = {0.0, 0.0, 0.0};
    for (int i = 0; i < 3; ++i) {
        b[i] = view.barycentrics[3 * p + i];
        const long long place = corner_color(view, view.triangle[p], i);
        for (int c = 0; c < view.channels; ++c) {
            into.color(place + c, b[i] * g[c]);
            cotangent[i] += static_cast<double>(g[c]) * view.colors[place + c];
        }
    }
    if (!into.targets.vertices) return;
    const Vector3<double> u = interpolation_derivative(inverse_of(view, camera_of(view), p), b, cotangent);
    for (int i = 0; i < 3; ++i) {
        const double moved[3] = {-b[i] * u.x, -b[i] * u.y, -b[i] * u.z};
        into.vertex(k[i], moved);
    }
}

// What the colour of pixel p, with the cotangents g, gives; colours of pixels themselves and of the background are none of the
// targets.
template <class Into>
__device__ void collect_shaded(const ShadedView& view, long long p, const float* g, Into& into) {
    const long long face = view.triangle[p];
    const bool interpolated = has_colors_of(view, ColorsOf::kVertices) || has_colors_of(view, ColorsOf::kCorners);
    if (face < 0) return;
    if (interpolated) return collect_interpolated(view, p, g, into);
    for (int c = 0; c < view.channels; ++c) into.color(face * view.channels + c, g[c]);
}

}  // namespace etsplat
