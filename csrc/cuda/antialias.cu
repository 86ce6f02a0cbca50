// Shading and silhouette antialiasing of what the z-buffer found in one view (csrc/math/antialias.h), with gradients.
//
// Forward: points projected, silhouette edges marked, pixels shaded; then each pixel looks at its four pairs of neighbours
// and takes what their silhouettes give it, so that nothing is scattered. Backward: each pixel gathers its cotangent in
// the same way; then cotangents go to colours and corners, many pixels to a place, as fixed-point sums (fixed_sums.h):
// the same bits in every run. Each pair is evaluated by both its pixels, and few pairs have anything between them: some 50
// bytes a pixel bound the forward; atomics in L2, 3 a pixel for colours, bound the backward.
#include "cuda/fixed_sums.h"
#include "math/antialias.h"
#include "math/triangle.h"

using namespace etsplat;

constexpr int kThreads = kBlock;

struct AntialiasView {
    const float *vertices, *viewmat, *K, *barycentrics, *depth, *colors, *background;
    const int *faces, *pair_offsets, *paired_faces, *triangle;
    long long num_vertices, num_faces;
    int width, height, channels, per_face;
    float near_plane;
};

struct ScreenPoint {
    double at[2];
    int drawn;
};

__device__ PinholeCamera camera_of(const AntialiasView& view) {
    return pinhole_camera(view.viewmat, view.K);
}

__device__ long long thread_index() { return static_cast<long long>(blockIdx.x) * kThreads + threadIdx.x; }
__device__ long long pixel_count(const AntialiasView& view) { return static_cast<long long>(view.width) * view.height; }

extern "C" __global__ void antialias_points(AntialiasView view, ScreenPoint* points) {
    const long long v = thread_index();
    if (v >= view.num_vertices) return;
    const float* p = view.vertices + 3 * v;
    const double world[3] = {p[0], p[1], p[2]};
    double seen[3];
    ScreenPoint q;
    const PinholeCamera camera = camera_of(view);
    to_camera(camera, world, seen);
    project(camera, seen, q.at[0], q.at[1]);
    q.drawn = seen[2] > static_cast<double>(view.near_plane) && q.at[0] - q.at[0] == 0.0 && q.at[1] - q.at[1] == 0.0;
    points[v] = q;
}

// Bit k of a face: its edge from corner k to k + 1 is a silhouette, that is, no face across it lies on the other side.
extern "C" __global__ void antialias_silhouettes(AntialiasView view, const ScreenPoint* points, unsigned char* bits) {
    const long long f = thread_index();
    if (f >= view.num_faces) return;
    const int* own = view.faces + 3 * f;
    int found = 7;
    for (int i = view.pair_offsets[f]; i < view.pair_offsets[f + 1]; ++i) {
        const int* other = view.faces + 3 * static_cast<long long>(view.paired_faces[i]);
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

extern "C" __global__ void antialias_shade(AntialiasView view, float* shaded) {
    const long long p = thread_index();
    if (p >= pixel_count(view)) return;
    float* out = shaded + p * view.channels;
    const long long face = view.triangle[p];
    for (int c = 0; c < view.channels; ++c) {
        if (face < 0) {
            out[c] = view.background[c];
        } else if (view.per_face) {
            out[c] = view.colors[face * view.channels + c];
        } else {
            const float* b = view.barycentrics + 3 * p;
            float color[3];
            for (int i = 0; i < 3; ++i) {
                color[i] = view.colors[static_cast<long long>(view.faces[3 * face + i]) * view.channels + c];
            }
            out[c] = b[0] * color[0] + b[1] * color[1] + b[2] * color[2];
        }
    }
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
    const AntialiasView& view = scene.view;
    const bool exists = x >= 0 && y >= 0 && x + (axis == 0) < view.width && y + (axis == 1) < view.height;
    if (!exists) return false;
    const long long first = static_cast<long long>(y) * view.width + x, second = first + (axis == 0 ? 1 : view.width);
    const int face[2] = {view.triangle[first], view.triangle[second]};
    if (face[0] == face[1]) return false;
    const bool forward = face[1] < 0 || (face[0] >= 0 && view.depth[first] <= view.depth[second]);
    const long long nearer = face[forward ? 0 : 1];
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
    const int x = static_cast<int>(p % scene.view.width), y = static_cast<int>(p / scene.view.width);
#pragma unroll 1
    for (int side = 0; side < 4; ++side) {
        PairBlend pair;
        const int axis = side == 0 || side == 3 ? 1 : 0;
        if (find_pair(scene, side == 1 ? x - 1 : x, side == 0 ? y - 1 : y, axis, pair)) visit(pair);
    }
}

extern "C" __global__ void antialias_blend(Scene scene, const float* shaded, float* image) {
    const long long p = thread_index();
    if (p >= pixel_count(scene.view)) return;
    const int channels = scene.view.channels;
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
    if (p >= pixel_count(scene.view)) return;
    const int channels = scene.view.channels;
    for (int c = 0; c < channels; ++c) grad_shaded[p * channels + c] = grad_image[p * channels + c];
    for_each_pair(scene, p, [&](const PairBlend& pair) {
        for (int c = 0; c < channels; ++c) {
            const float moved = pair.blend.weight * grad_image[pair.to * channels + c];
            grad_shaded[p * channels + c] += pair.to == p ? -moved : moved;
        }
    });
}

// Where gradients go, null if nobody wants them; `largest` has a number for each of the three.
struct Targets {
    FixedSum *vertices, *colors, *background;
    unsigned* largest;
};

// Adds (or, if Measure, looks at) what one pixel gives to the targets.
template <bool Measure>
struct Collector {
    const Targets& targets;
    float magnitudes[3] = {};
    double scales[3] = {};

    __device__ explicit Collector(const Targets& t) : targets(t) {
        for (int i = 0; i < 3 && !Measure; ++i) scales[i] = fixed_scale(t.largest[i]);
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
    __device__ void background(int channel, double value) {
        if (targets.background) add(2, targets.background, channel, value);
    }
};

// The weight of a pair's blend moves the ends of its silhouette.
template <class Into>
__device__ void collect_silhouette(const Scene& scene, const PairBlend& pair, const float* shaded,
                                   const float* grad_image, Into& into) {
    const int channels = scene.view.channels;
    double by_weight = 0.0;
    for (int c = 0; c < channels; ++c) {
        const float step = shaded[pair.from * channels + c] - shaded[pair.to * channels + c];
        by_weight += static_cast<double>(grad_image[pair.to * channels + c]) * step;
    }
    const PinholeCamera camera = camera_of(scene.view);
    for (int end = 0; end < 2; ++end) {
        const float* p = scene.view.vertices + 3 * static_cast<long long>(pair.ends[end]);
        const double world[3] = {p[0], p[1], p[2]};
        double seen[3], grad_seen[3] = {0.0, 0.0, 0.0}, grad_world[3], x, y;
        to_camera(camera, world, seen);
        project(camera, seen, x, y);
        project_backward(camera, seen, x, y, by_weight * pair.blend.derivative[end][0],
                         by_weight * pair.blend.derivative[end][1], grad_seen);
        to_world_gradient(camera, grad_seen, grad_world);
        into.vertex(pair.ends[end], grad_world);
    }
}

// An interpolated colour gives to the colours of three vertices, and to their positions.
template <class Into>
__device__ void collect_interpolated(const AntialiasView& view, long long p, const float* g, Into& into) {
    const int* k = view.faces + 3 * static_cast<long long>(view.triangle[p]);
    double b[3], cotangent[3] = {0.0, 0.0, 0.0};
    for (int i = 0; i < 3; ++i) {
        b[i] = view.barycentrics[3 * p + i];
        const long long place = static_cast<long long>(k[i]) * view.channels;
        for (int c = 0; c < view.channels; ++c) {
            into.color(place + c, b[i] * g[c]);
            cotangent[i] += static_cast<double>(g[c]) * view.colors[place + c];
        }
    }
    if (!into.targets.vertices) return;
    const PinholeCamera camera = camera_of(view);
    Vector3<double> corner[3];
    for (int i = 0; i < 3; ++i) {
        double relative[3];  // to the camera's centre
        for (int j = 0; j < 3; ++j) {
            relative[j] = view.vertices[3 * static_cast<long long>(k[i]) + j];
            for (int r = 0; r < 3; ++r) {
                relative[j] += static_cast<double>(camera.rotation[3 * r + j]) * camera.translation[r];
            }
        }
        corner[i] = {relative[0], relative[1], relative[2]};
    }
    const Vector3<double> u = interpolation_derivative(view_inverse(corner), b, cotangent);
    for (int i = 0; i < 3; ++i) {
        const double moved[3] = {-b[i] * u.x, -b[i] * u.y, -b[i] * u.z};
        into.vertex(k[i], moved);
    }
}

template <class Into>
__device__ void collect(const Scene& scene, long long p, const float* shaded, const float* grad_image,
                        const float* grad_shaded, Into& into) {
    const AntialiasView& view = scene.view;
    if (into.targets.vertices) {  // the pairs that begin here
        const int x = static_cast<int>(p % view.width), y = static_cast<int>(p / view.width);
        PairBlend pair;
        for (int axis = 0; axis < 2; ++axis) {
            if (find_pair(scene, x, y, axis, pair)) collect_silhouette(scene, pair, shaded, grad_image, into);
        }
    }
    const float* g = grad_shaded + p * view.channels;
    const long long face = view.triangle[p];
    if (face >= 0 && !view.per_face) return collect_interpolated(view, p, g, into);
    for (int c = 0; c < view.channels; ++c) {
        if (face < 0) into.background(c, g[c]);
        else into.color(face * view.channels + c, g[c]);
    }
}

extern "C" __global__ void antialias_measure(Scene scene, const float* shaded, const float* grad_image,
                                             const float* grad_shaded, Targets targets) {
    const long long p = thread_index();
    Collector<true> into(targets);
    if (p < pixel_count(scene.view)) collect(scene, p, shaded, grad_image, grad_shaded, into);
    for (int i = 0; i < 3; ++i) record_largest(into.magnitudes[i], targets.largest + i);
}

extern "C" __global__ void antialias_scatter(Scene scene, const float* shaded, const float* grad_image,
                                             const float* grad_shaded, Targets targets) {
    const long long p = thread_index();
    Collector<false> into(targets);
    if (p < pixel_count(scene.view)) collect(scene, p, shaded, grad_image, grad_shaded, into);
}

// Adds `count` sums to a gradient.
extern "C" __global__ void antialias_finish(const FixedSum* sums, const unsigned* largest, long long count,
                                            float* gradient) {
    const long long i = thread_index();
    if (i < count) gradient[i] += from_fixed(sums[i], *largest);
}
