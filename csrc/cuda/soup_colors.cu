// Colours of triangles as cameras see them, from spherical harmonics, and back. One thread to a triangle, all views in order,
// so that sums over views are the same bits in every run. The coefficients beside the constant one pass through shared
// memory, and their gradients take their place there. Definitions: DEGREE, of the harmonics that are drawn, and BASES, how
// many coefficients beside the constant one there are; those of higher bands are not read.
//
// Bytes bound it: of a triangle of a soup at degree 3 in one view 240 forward, 456 backward, 228 of these if the whole
// block is out of view.
#include "cuda/staged_rows.h"
#include "math/spherical_harmonics.h"

using namespace etsplat;

using Vector = Vector3<float>;

constexpr int kUsed = (DEGREE + 1) * (DEGREE + 1) - 1;
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

// A block of triangles without any gradient (out of view) reads no coefficients.
extern "C" __global__ void soup_backward(const Vector* corners, const float* rest, const Vector* centers,
                                         long long triangles, int views, const float* colors,
                                         const float* grad_colors, Vector* grad_corners, float* grad_dc,
                                         float* grad_rest) {
    __shared__ float staged[Rest::kRoom];
    const Rest rows(staged, triangles);
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
    rows.store(grad_rest);
}
