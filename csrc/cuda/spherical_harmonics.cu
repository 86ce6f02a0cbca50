// Colours from spherical harmonics, and back. One thread to a point, all its views in order, so that sums over views are
// the same bits in every run. The coefficients of a block's points, up to kStaged numbers each, pass through shared
// memory: global memory sees whole lines, and rows one word longer than the data keep the banks apart.
//
// Bytes bound it: of a triangle of a soup at degree 3 in one view 240 forward, 456 backward, 228 of these if the whole
// block is out of view.
#include "cuda/common.h"
#include "math/spherical_harmonics.h"

using namespace etsplat;

using Vector = Vector3<float>;

constexpr int kThreads = 64;
constexpr int kStaged = 48;

// Rows of `width` numbers of a block's points, in shared memory.
struct Rows {
    float* shared;
    long long first;  // point of the block
    int count, width;

    __device__ float* mine() const { return shared + threadIdx.x * (kStaged + 1); }
    __device__ void load(const float* from) const {
        for (int i = threadIdx.x; i < count * width; i += kThreads) {
            shared[i / width * (kStaged + 1) + i % width] = from[first * width + i];
        }
        __syncthreads();
    }
    __device__ void store(float* to) const {
        __syncthreads();
        for (int i = threadIdx.x; i < count * width; i += kThreads) {
            to[first * width + i] = shared[i / width * (kStaged + 1) + i % width];
        }
    }
};

__device__ Rows rows_of_block(float* shared, long long points, int width) {
    const long long first = static_cast<long long>(blockIdx.x) * kThreads, left = points - first;
    return {shared, first, static_cast<int>(left < kThreads ? left : kThreads), width};
}

template <int Degree>
__device__ void sh_colors(Vector unit, const float* coefficients, int channels, float* colors) {
    float basis[kMaxShBases];
    sh_basis(Degree, unit, basis);
    for (int c = 0; c < channels; ++c) {
        float sum = 0.5f;
        for (int k = 0; k < (Degree + 1) * (Degree + 1); ++k) sum += basis[k] * coefficients[k * channels + c];
        colors[c] = vmax(sum, 0.0f);
    }
}

// Adds to `sums`, the gradient by the coefficients; returns that by the unit direction.
template <int Degree>
__device__ Vector sh_colors_backward(Vector unit, const float* coefficients, int channels, const float* colors,
                                     const float* grad_colors, float* sums) {
    float basis[kMaxShBases], along[kMaxShBases] = {};
    sh_basis(Degree, unit, basis);
    for (int c = 0; c < channels; ++c) {
        const float cotangent = colors[c] > 0.0f ? grad_colors[c] : 0.0f;  // a colour of 0 was clamped
        for (int k = 0; k < (Degree + 1) * (Degree + 1); ++k) {
            sums[k * channels + c] += cotangent * basis[k];
            along[k] += cotangent * coefficients[k * channels + c];
        }
    }
    return sh_basis_backward(Degree, unit, along);
}

extern "C" __global__ void sh_forward(const float* coefficients, const Vector* directions, long long points, int views,
                                      int bases, int channels, int degree, float* colors) {
    __shared__ float staged[kThreads * (kStaged + 1)];
    const int width = bases * channels;
    const Rows rows = rows_of_block(staged, points, width);
    if (width <= kStaged) rows.load(coefficients);
    if (static_cast<int>(threadIdx.x) >= rows.count) return;
    const long long n = rows.first + threadIdx.x;
    const float* mine = width <= kStaged ? rows.mine() : coefficients + n * width;
    for (int view = 0; view < views; ++view) {
        const long long at = view * points + n;
        Vector unit;
        float length;
        const int usable = sh_direction(degree, directions[at], unit, length);
        float* out = colors + at * channels;
        switch (usable) {
            case 0: sh_colors<0>(unit, mine, channels, out); break;
            case 1: sh_colors<1>(unit, mine, channels, out); break;
            case 2: sh_colors<2>(unit, mine, channels, out); break;
            default: sh_colors<3>(unit, mine, channels, out);
        }
    }
}

extern "C" __global__ void sh_backward(const float* coefficients, const Vector* directions, long long points, int views,
                                       int bases, int channels, int degree, const float* colors,
                                       const float* grad_colors, float* grad_coefficients, Vector* grad_directions) {
    __shared__ float staged[kThreads * (kStaged + 1)], staged_sums[kThreads * (kStaged + 1)];
    const int width = bases * channels;
    const Rows rows = rows_of_block(staged, points, width), sums = rows_of_block(staged_sums, points, width);
    const bool through_shared = width <= kStaged;
    if (through_shared) rows.load(coefficients);
    if (static_cast<int>(threadIdx.x) < rows.count) {
        const long long n = rows.first + threadIdx.x;
        const float* mine = through_shared ? rows.mine() : coefficients + n * width;
        float* my_sums = through_shared ? sums.mine() : grad_coefficients + n * width;
        for (int k = 0; k < width; ++k) my_sums[k] = 0.0f;
        for (int view = 0; view < views; ++view) {
            const long long at = view * points + n;
            Vector unit, g;
            float length;
            const int usable = sh_direction(degree, directions[at], unit, length);
            const float *color = colors + at * channels, *grad = grad_colors + at * channels;
            switch (usable) {
                case 0: g = sh_colors_backward<0>(unit, mine, channels, color, grad, my_sums); break;
                case 1: g = sh_colors_backward<1>(unit, mine, channels, color, grad, my_sums); break;
                case 2: g = sh_colors_backward<2>(unit, mine, channels, color, grad, my_sums); break;
                default: g = sh_colors_backward<3>(unit, mine, channels, color, grad, my_sums);
            }
            grad_directions[at] = sh_direction_backward(usable, unit, length, g);
        }
    }
    if (through_shared) sums.store(grad_coefficients);
}

__device__ Vector centroid(const Vector* corners, long long n) {
    const Vector* corner = corners + 3 * n;
    return (1.0f / 3.0f) * (corner[0] + corner[1] + corner[2]);
}

// Colours (views, N, 3) of triangles with corners (N, 3), dc (N, 3), rest (N, bases, 3), seen from centers (views).
extern "C" __global__ void soup_forward(const Vector* corners, const float* dc, const float* rest,
                                        const Vector* centers, long long triangles, int views, int bases, int degree,
                                        float* colors) {
    __shared__ float staged[kThreads * (kStaged + 1)];
    const Rows rows = rows_of_block(staged, triangles, 3 * bases);
    rows.load(rest);
    if (static_cast<int>(threadIdx.x) >= rows.count) return;
    const long long n = rows.first + threadIdx.x;
    const Vector middle = centroid(corners, n);
    for (int view = 0; view < views; ++view) {
        const Vector toward = middle - centers[view];
        float* color = colors + 3 * (view * triangles + n);
        switch (degree) {
            case 0: soup_color(0, toward, dc + 3 * n, rows.mine(), color); break;
            case 1: soup_color(1, toward, dc + 3 * n, rows.mine(), color); break;
            case 2: soup_color(2, toward, dc + 3 * n, rows.mine(), color); break;
            default: soup_color(3, toward, dc + 3 * n, rows.mine(), color);
        }
    }
}

// A colour of 0 was clamped and passes no gradient; a block of triangles without any (out of view) reads no coefficients.
extern "C" __global__ void soup_backward(const Vector* corners, const float* rest, const Vector* centers,
                                         long long triangles, int views, int bases, int degree, const float* colors,
                                         const float* grad_colors, Vector* grad_corners, float* grad_dc,
                                         float* grad_rest) {
    __shared__ float staged[kThreads * (kStaged + 1)], staged_sums[kThreads * (kStaged + 1)];
    const Rows rows = rows_of_block(staged, triangles, 3 * bases), sums = rows_of_block(staged_sums, triangles, 3 * bases);
    const bool used = static_cast<int>(threadIdx.x) < rows.count;
    const long long n = rows.first + threadIdx.x;
    bool seen = false;
    for (int k = 0; k < 3 * views && used; ++k) {
        const long long at = 3 * (k / 3 * triangles + n) + k % 3;
        seen = seen || (colors[at] > 0.0f && grad_colors[at] != 0.0f);
    }
    if (__syncthreads_or(seen)) rows.load(rest);
    Vector moved{0.0f, 0.0f, 0.0f};
    float of_dc[3] = {};
    for (int k = 0; k < 3 * bases; ++k) sums.mine()[k] = 0.0f;
    if (seen) {
        const Vector middle = centroid(corners, n);
        for (int view = 0; view < views; ++view) {
            const long long at = 3 * (view * triangles + n);
            const Vector toward = middle - centers[view];
            float cotangent[3];
            for (int c = 0; c < 3; ++c) cotangent[c] = colors[at + c] > 0.0f ? grad_colors[at + c] : 0.0f;
            Vector by_toward;
            switch (degree) {
                case 0: by_toward = soup_color_backward(0, toward, rows.mine(), cotangent, of_dc, sums.mine()); break;
                case 1: by_toward = soup_color_backward(1, toward, rows.mine(), cotangent, of_dc, sums.mine()); break;
                case 2: by_toward = soup_color_backward(2, toward, rows.mine(), cotangent, of_dc, sums.mine()); break;
                default: by_toward = soup_color_backward(3, toward, rows.mine(), cotangent, of_dc, sums.mine());
            }
            moved = moved + by_toward;
        }
    }
    if (used) {
        for (int corner = 0; corner < 3; ++corner) grad_corners[3 * n + corner] = (1.0f / 3.0f) * moved;
        for (int c = 0; c < 3; ++c) grad_dc[3 * n + c] = of_dc[c];
    }
    sums.store(grad_rest);
}
