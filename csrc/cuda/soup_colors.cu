// Colours of triangles as cameras see them, from spherical harmonics, and back. One thread to a triangle, all views in order,
// so that sums over views are the same bits in every run. The coefficients beside the constant one pass through shared
// memory, and their gradients take their place there. Definitions: DEGREE, of the harmonics that are drawn, and BASES, how
// many coefficients beside the constant one there are; those of higher bands are not read.
//
// Bytes bound it: of a triangle of a soup at degree 3 in one view 240 forward and 468 backward, 216 less if the whole block is
// out of view; with Adam 1,188, where both apart are 1,728.
#include "cuda/staged_rows.h"
#include "math/adam.h"
#include "math/spherical_harmonics.h"

using namespace etsplat;

using Vector = Vector3<float>;

constexpr int kUsed = (DEGREE + 1) * (DEGREE + 1) - 1;
constexpr int kTogether = 3;  // updates of a thread that wait for memory at once; divides all numbers of a row
using Rest = StagedRows<3 * kUsed, 3 * BASES>;

__device__ Vector centroid(const Vector* corners, long long n) {
    const Vector* corner = corners + 3 * n;
    return (1.0f / 3.0f) * (corner[0] + corner[1] + corner[2]);
}

// Colours (views, N, 3) of triangles with corners (N, 3), dc (N, 3), rest (N, BASES, 3), seen from centers (views).
extern "C" __global__ void soup_forward(const Vector* corners, const float* dc, const float* rest,
                                        const Vector* centers, long long triangles, int views, float* colors) {
    __shared__ float staged[Rest::kRoom];
    const Rest rows(staged, triangles);
    rows.load(rest);
    if (!rows.has_point()) return;
    const long long n = rows.first + threadIdx.x;
    const Vector middle = centroid(corners, n);
    for (int view = 0; view < views; ++view)
        soup_color(DEGREE, middle - centers[view], dc + 3 * n, rows.mine(), colors + 3 * (view * triangles + n));
}

// A triangle's colour in a view, as its gradients need it.
struct Seen {
    float cotangent[3], length;
    Vector unit;

    __device__ Seen(const float* color, const float* grad_color, Vector toward) {
        for (int c = 0; c < 3; ++c) cotangent[c] = color[c] > 0.0f ? grad_color[c] : 0.0f;  // a colour of 0 was clamped
        unit = direction(toward, length);
    }
    __device__ bool directed() const { return DEGREE > 0 && length > kMinLength; }

    // The gradient by the line of sight.
    __device__ Vector by_toward(const float* rest) const {
        if (!directed()) return {0.0f, 0.0f, 0.0f};
        float along[kMaxShBases] = {};
        for (int k = 1; k <= kUsed; ++k)
            for (int c = 0; c < 3; ++c) along[k] += cotangent[c] * rest[3 * (k - 1) + c];
        const Vector g = sh_basis_backward(DEGREE, unit, along);
        return (1.0f / length) * (g - dot(g, unit) * unit);  // through the normalisation
    }
    __device__ void add_coefficients(float* grad_dc, float* grad_rest) const {
        for (int c = 0; c < 3; ++c) grad_dc[c] += kSh0 * cotangent[c];
        if (!directed()) return;
        float basis[kMaxShBases];
        sh_basis(DEGREE, unit, basis);
        for (int k = 1; k <= kUsed; ++k)
            for (int c = 0; c < 3; ++c) grad_rest[3 * (k - 1) + c] += cotangent[c] * basis[k];
    }
};

// Gradients by corners and the constant coefficients; those by the others end in `rows`. A block of triangles without any
// gradient (out of view) reads no coefficients.
__device__ void soup_gradients(const Rest& rows, const Vector* corners, const float* rest, const Vector* centers,
                               long long triangles, int views, const float* colors, const float* grad_colors,
                               Vector* grad_corners, float* grad_dc) {
    const bool used = rows.has_point();
    const long long n = rows.first + threadIdx.x;
    bool seen = false;
    for (int k = 0; k < 3 * views && used; ++k) {
        const long long at = 3 * (k / 3 * triangles + n) + k % 3;
        seen = seen || (colors[at] > 0.0f && grad_colors[at] != 0.0f);
    }
    if (__syncthreads_or(seen)) rows.load(rest);
    const auto in_view = [&](int view, Vector middle) {
        const long long at = 3 * (view * triangles + n);
        return Seen(colors + at, grad_colors + at, middle - centers[view]);
    };
    Vector moved{0.0f, 0.0f, 0.0f}, middle{0.0f, 0.0f, 0.0f};
    if (seen) {
        middle = centroid(corners, n);
        for (int view = 0; view < views; ++view) moved = moved + in_view(view, middle).by_toward(rows.mine());
    }
    float of_dc[3] = {}, *of_rest = rows.mine();
    for (int k = 0; k < 3 * kUsed; ++k) of_rest[k] = 0.0f;
    for (int view = 0; view < views && seen; ++view) in_view(view, middle).add_coefficients(of_dc, of_rest);
    if (used) {
        for (int corner = 0; corner < 3; ++corner) grad_corners[3 * n + corner] = (1.0f / 3.0f) * moved;
        for (int c = 0; c < 3; ++c) grad_dc[3 * n + c] = of_dc[c];
    }
}

extern "C" __global__ void soup_backward(const Vector* corners, const float* rest, const Vector* centers,
                                         long long triangles, int views, const float* colors,
                                         const float* grad_colors, Vector* grad_corners, float* grad_dc,
                                         float* grad_rest) {
    __shared__ float staged[Rest::kRoom];
    const Rest rows(staged, triangles);
    soup_gradients(rows, corners, rest, centers, triangles, views, colors, grad_colors, grad_corners, grad_dc);
    rows.store(grad_rest);
}

// The same with a step of Adam (csrc/cuda/adam.cu, to the bit) on the coefficients in the place of their gradient, which is
// nowhere in memory then. Where `halted` is not 0 nothing is done, and no gradient is written. `decay` may be null.
struct RestStep {
    float *first, *second;
    const float *step_size, *second_correction, *decay;
    float first_weight, second_decay, second_weight, eps;
    const int* halted;
};

extern "C" __global__ void soup_adam(const Vector* corners, float* rest, const Vector* centers, long long triangles,
                                     int views, const float* colors, const float* grad_colors, Vector* grad_corners,
                                     float* grad_dc, RestStep step) {
    if (*step.halted) return;
    __shared__ float staged[Rest::kRoom];
    const Rest rows(staged, triangles);
    soup_gradients(rows, corners, rest, centers, triangles, views, colors, grad_colors, grad_corners, grad_dc);
    const AdamCoefficients<float> k{step.first_weight, step.second_decay,       step.second_weight,
                                    *step.step_size,   *step.second_correction, step.eps};
    const float decay = step.decay ? *step.decay : 0.0f;
    if constexpr (BASES > 0) {
        __syncthreads();
#pragma unroll 1
        for (int j = 0; j < 3 * BASES; j += kTogether) {
            float value[kTogether], first[kTogether], second[kTogether];
            for (int t = 0; t < kTogether; ++t) {
                const auto [used, at, gradient] = rows.number(j + t);
                value[t] = used ? rest[at] : 0.0f;
                first[t] = used ? step.first[at] : 0.0f;
                second[t] = used ? step.second[at] : 0.0f;
            }
            for (int t = 0; t < kTogether; ++t) {
                const auto [used, at, gradient] = rows.number(j + t);
                adam_update(value[t], first[t], second[t], gradient, decay, k);
                if (!used) continue;
                rest[at] = value[t];
                step.first[at] = first[t];
                step.second[at] = second[t];
            }
        }
    }
}
