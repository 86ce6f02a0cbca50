// Colours from spherical harmonics, and back. One thread to a point, all its views in order, so that sums over views are
// the same bits in every run. The coefficients of a block's points pass through shared memory where there are few, and their
// gradients take their place there. Definitions: DEGREE, BASES and CHANNELS; coefficients of higher bands are not read.
// Bytes bound it.
#include "cuda/staged_rows.h"
#include "math/spherical_harmonics.h"

using namespace etsplat;

using Vector = Vector3<float>;

constexpr int kWidth = (DEGREE + 1) * (DEGREE + 1) * CHANNELS, kStride = BASES * CHANNELS;
constexpr bool kStaged = kWidth <= kMostStaged;
using Rows = StagedRows<kStaged ? kWidth : 0, kStride>;

template <int Degree>
__device__ void sh_colors(Vector unit, const float* coefficients, float* colors) {
    float basis[kMaxShBases];
    sh_basis(Degree, unit, basis);
    for (int c = 0; c < CHANNELS; ++c) {
        float sum = 0.5f;
        for (int k = 0; k < (Degree + 1) * (Degree + 1); ++k) sum += basis[k] * coefficients[k * CHANNELS + c];
        colors[c] = vmax(sum, 0.0f);
    }
}

// A colour of 0 was clamped.
__device__ float cotangent_of(const float* colors, const float* grad_colors, int c) {
    return colors[c] > 0.0f ? grad_colors[c] : 0.0f;
}

// The gradient by the unit direction.
template <int Degree>
__device__ Vector sh_by_direction(Vector unit, const float* coefficients, const float* colors, const float* grad_colors) {
    float along[kMaxShBases] = {};
    for (int c = 0; c < CHANNELS; ++c) {
        const float cotangent = cotangent_of(colors, grad_colors, c);
        for (int k = 0; k < (Degree + 1) * (Degree + 1); ++k) along[k] += cotangent * coefficients[k * CHANNELS + c];
    }
    return sh_basis_backward(Degree, unit, along);
}

// Adds the gradient by the coefficients.
template <int Degree>
__device__ void sh_by_coefficients(Vector unit, const float* colors, const float* grad_colors, float* sums) {
    float basis[kMaxShBases];
    sh_basis(Degree, unit, basis);
    for (int c = 0; c < CHANNELS; ++c) {
        const float cotangent = cotangent_of(colors, grad_colors, c);
        for (int k = 0; k < (Degree + 1) * (Degree + 1); ++k) sums[k * CHANNELS + c] += cotangent * basis[k];
    }
}

extern "C" __global__ void sh_forward(const float* coefficients, const Vector* directions, long long points, int views,
                                      float* colors) {
    __shared__ float staged[Rows::kRoom];
    const Rows rows(staged, points);
    if (kStaged) rows.load(coefficients);
    if (!rows.has_point()) return;
    const long long n = rows.first + threadIdx.x;
    const float* mine = kStaged ? rows.mine() : coefficients + n * kStride;
    for (int view = 0; view < views; ++view) {
        const long long at = view * points + n;
        Vector unit;
        float length;
        if (sh_direction(DEGREE, directions[at], unit, length) == 0) sh_colors<0>(unit, mine, colors + at * CHANNELS);
        else sh_colors<DEGREE>(unit, mine, colors + at * CHANNELS);
    }
}

extern "C" __global__ void sh_backward(const float* coefficients, const Vector* directions, long long points, int views,
                                       const float* colors, const float* grad_colors, float* grad_coefficients,
                                       Vector* grad_directions) {
    __shared__ float staged[Rows::kRoom];
    const Rows rows(staged, points);
    if (kStaged) rows.load(coefficients);
    if (rows.has_point()) {
        const long long n = rows.first + threadIdx.x;
        const float* mine = kStaged ? rows.mine() : coefficients + n * kStride;
        Vector unit;
        float length;
        for (int view = 0; view < views; ++view) {
            const long long at = view * points + n;
            const int usable = sh_direction(DEGREE, directions[at], unit, length);
            const float *color = colors + at * CHANNELS, *grad = grad_colors + at * CHANNELS;
            const Vector g = usable == 0 ? Vector{0.0f, 0.0f, 0.0f} : sh_by_direction<DEGREE>(unit, mine, color, grad);
            grad_directions[at] = sh_direction_backward(usable, unit, length, g);
        }
        float* sums = kStaged ? rows.mine() : grad_coefficients + n * kStride;
        for (int k = 0; k < (kStaged ? kWidth : kStride); ++k) sums[k] = 0.0f;
        for (int view = 0; view < views; ++view) {
            const long long at = view * points + n;
            const float *color = colors + at * CHANNELS, *grad = grad_colors + at * CHANNELS;
            if (sh_direction(DEGREE, directions[at], unit, length) == 0) sh_by_coefficients<0>(unit, color, grad, sums);
            else sh_by_coefficients<DEGREE>(unit, color, grad, sums);
        }
    }
    if (kStaged) rows.store(grad_coefficients);
}
