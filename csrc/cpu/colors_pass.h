// The data of colours of separate triangles and the interface of their loops, which exist once per instruction set
// (simd/colors.h).
#pragma once

#include <cstdint>

#include "math/spherical_harmonics.h"

namespace etsplat {

constexpr int64_t kColorGroup = 16;  // triangles in lanes

struct ColorsPass {
    const Vector3<float>* corners;  // (N, 3)
    const float* dc;                // (N, 1, 3)
    const float* rest;              // (N, bases, 3)
    const Vector3<float>* centers;  // (views)
    int64_t triangles, views, bases;
    int degree;
};

// Of the views of each triangle; gradients are written.
struct ColorsGradients {
    const float* colors;  // (views, N, 3), as are their gradients
    const float* grad_colors;
    Vector3<float>* corners;
    float *dc, *rest;
};

// Both for the kColorGroup triangles from `first` on.
struct ColorsKernels {
    void (*forward)(const ColorsPass&, int64_t first, float* colors);
    void (*backward)(const ColorsPass&, int64_t first, const ColorsGradients&);
};

}  // namespace etsplat
