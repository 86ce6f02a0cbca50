// Z-buffer rasterization of one view, strip by strip of its rows of samples, so that the z-buffer (8 bytes a sample) stays
// in the L2 cache and the memory bounded. opaque_rows finds each triangle's rows once. For every strip, opaque_draw sets up
// the triangles that meet it, one to a lane, in double as the CPU engine does (csrc/math/opaque_triangle.h); a lane draws a
// small one by itself, the whole warp a large one. The z-buffer holds, in one number, the inverse depth and the
// complement of the index: its maximum is the nearest triangle, of equals the first, in whatever order they come. A
// resolve kernel turns the samples into pixels and leaves zeros for the next strip.
//
// Bound by atomics in L2 for large triangles, by the set-up in double for small ones.
#include "cuda/common.h"
#include "math/opaque_triangle.h"

using namespace etsplat;

constexpr int kThreads = 128;
constexpr int kSmall = 128;   // samples of the box of a triangle that one lane draws
constexpr int kChannels = 4;  // that a pixel sums at a time

using Sample = unsigned long long;  // 0: empty

struct OpaqueView {
    const float* points;    // (V, 3)
    const int* faces;       // (F, 3)
    const float* viewmat;   // (4, 4)
    const float* K;         // (3, 3)
    long long num_points, num_faces;
    int width, height;      // in samples
    int samples;            // along a side of a pixel
    float near_plane;
    int cull_backfaces;
};

// False for a face with an index out of range, which is not drawn.
__device__ bool load_corners(const OpaqueView& view, long long face, OpaqueVertex* corners) {
    const int* k = view.faces + 3 * face;
    for (int i = 0; i < 3; ++i) {
        if (k[i] < 0 || k[i] >= view.num_points) return false;
        corners[i] = project_opaque(view.viewmat, view.K, view.near_plane, view.samples,
                                  view.points + 3 * static_cast<long long>(k[i]));
    }
    return true;
}

// Its bounds are empty where it draws nothing.
__device__ OpaqueTriangle load_triangle(const OpaqueView& view, long long face) {
    OpaqueVertex corners[3];
    OpaqueTriangle t;
    const bool draws = load_corners(view, face, corners) &&
                       set_up_opaque(corners, opaque_bounds(corners, view.width, view.height), view.cull_backfaces != 0, t);
    if (!draws) t.bounds = {0, 0, 0, 0};
    return t;
}

__device__ int face_of(Sample sample) { return static_cast<int>(~static_cast<unsigned>(sample)); }

// rows (F, 2): first row of samples and the one after the last; equal where the triangle draws nothing.
extern "C" __global__ void opaque_rows(OpaqueView view, int* rows) {
    const long long f = static_cast<long long>(blockIdx.x) * kThreads + threadIdx.x;
    if (f >= view.num_faces) return;
    const OpaqueBounds bounds = load_triangle(view, f).bounds;
    rows[2 * f] = bounds.y_begin;
    rows[2 * f + 1] = bounds.y_end;
}

// Rows [begin, end) of a triangle, every `stride`-th column from `offset` on, into a buffer that starts at row `top`.
__device__ void draw(const OpaqueTriangle& t, long long face, int begin, int end, int offset, int stride, int width,
                     int top, Sample* buffer) {
    const float slope = static_cast<float>(t.inverse_depth_dx);
    const unsigned complement = ~static_cast<unsigned>(face);
    for (int y = begin; y < end; ++y) {
        int left, right;
        t.span(y, width, left, right);
        const float row = t.row_inverse_depth(y);
        Sample* line = buffer + static_cast<long long>(y - top) * width;
        for (int x = left + offset; x < right; x += stride) {
            const float w = t.inverse_depth_at(row, slope, x - t.bounds.x_begin);
            if (!(w > 0.0f)) continue;
            const Sample sample = static_cast<Sample>(__float_as_uint(w)) << 32 | complement;
            if (sample > load_relaxed(line + x)) atomicMax(line + x, sample);
        }
    }
}

extern "C" __global__ void opaque_draw(OpaqueView view, const int* rows, int top, int bottom, Sample* buffer) {
    __shared__ OpaqueTriangle shared[kThreads / kWarp];
    const int lane = lane_index();
    const long long first = static_cast<long long>(blockIdx.x) * kThreads + threadIdx.x - lane, f = first + lane;
    OpaqueTriangle t;
    int begin = 0, end = 0;
    if (f < view.num_faces) {
        begin = rows[2 * f] < top ? top : rows[2 * f];
        end = rows[2 * f + 1] > bottom ? bottom : rows[2 * f + 1];
    }
    if (begin < end) t = load_triangle(view, f);
    const bool small = begin < end && (end - begin) * static_cast<long long>(t.bounds.x_end - t.bounds.x_begin) <= kSmall;
    if (small) draw(t, f, begin, end, 0, 1, view.width, top, buffer);
    unsigned large = __ballot_sync(kAllLanes, begin < end && !small);
    OpaqueTriangle* common = shared + warp_index();
    for (; large; large &= large - 1) {
        const int leader = __ffs(static_cast<int>(large)) - 1;
        if (lane == leader) *common = t;
        __syncwarp();
        draw(*common, first + leader, __shfl_sync(kAllLanes, begin, leader), __shfl_sync(kAllLanes, end, leader), lane,
             kWarp, view.width, top, buffer);
        __syncwarp();  // before the next leader writes
    }
}

// One sample a pixel: index of the triangle, barycentrics, depth of the rows [top, bottom) of an image.
extern "C" __global__ void opaque_resolve(OpaqueView view, int top, int bottom, Sample* buffer, int* triangle,
                                        float* barycentrics, float* depth) {
    const long long i = static_cast<long long>(blockIdx.x) * kThreads + threadIdx.x;
    if (i >= static_cast<long long>(bottom - top) * view.width) return;
    const Sample sample = buffer[i];
    buffer[i] = 0;
    const long long pixel = static_cast<long long>(top) * view.width + i;
    float* b = barycentrics + 3 * pixel;
    triangle[pixel] = sample ? face_of(sample) : -1;
    depth[pixel] = b[0] = b[1] = b[2] = 0.0f;
    if (!sample) return;
    OpaqueVertex corners[3];
    load_corners(view, face_of(sample), corners);
    opaque_barycentrics(corners, static_cast<int>(i % view.width), top + static_cast<int>(i / view.width), b);
    depth[pixel] = 1.0f / __uint_as_float(static_cast<unsigned>(sample >> 32));
}

// colors: (F, C) if per_face, else (V, C). image (H, W, C + 1): the mean of premultiplied colour and of coverage.
extern "C" __global__ void opaque_shade(OpaqueView view, int top, int bottom, Sample* buffer, const float* colors,
                                      int per_face, int channels, float* image) {
    const int s = view.samples, width = view.width / s;
    const long long i = static_cast<long long>(blockIdx.x) * kThreads + threadIdx.x;
    if (i >= static_cast<long long>((bottom - top) / s) * width) return;
    const int x0 = static_cast<int>(i % width) * s, y0 = static_cast<int>(i / width) * s;
    float* out = image + (static_cast<long long>(top / s) * width + i) * (channels + 1);
    const float scale = 1.0f / static_cast<float>(s * s);
    float coverage = 0.0f;
    for (int first = 0; first == 0 || first < channels; first += kChannels) {
        const int count = channels - first < kChannels ? channels - first : kChannels;
        float sums[kChannels] = {};
        coverage = 0.0f;
        for (int k = 0; k < s * s; ++k) {
            const int x = x0 + k % s, y = y0 + k / s;
            const Sample sample = buffer[static_cast<long long>(y) * view.width + x];
            if (!sample) continue;
            coverage += 1.0f;
            const long long face = face_of(sample);
            const float* of_face = colors + face * channels + first;
            if (per_face) {
                for (int c = 0; c < kChannels; ++c) sums[c] += c < count ? of_face[c] : 0.0f;
                continue;
            }
            OpaqueVertex corners[3];
            float b[3];
            load_corners(view, face, corners);
            opaque_barycentrics(corners, x, top + y, b);
            const int* v = view.faces + 3 * face;
            const float* at[3];
            for (int j = 0; j < 3; ++j) at[j] = colors + static_cast<long long>(v[j]) * channels + first;
            for (int c = 0; c < kChannels; ++c) {
                sums[c] += c < count ? b[0] * at[0][c] + b[1] * at[1][c] + b[2] * at[2][c] : 0.0f;
            }
        }
        for (int c = 0; c < count; ++c) out[first + c] = sums[c] * scale;
    }
    out[channels] = coverage * scale;
    for (int k = 0; k < s * s; ++k) buffer[static_cast<long long>(y0 + k / s) * view.width + x0 + k % s] = 0;
}
