// Area of a triangle and its gradient: with n the unit normal, dA/da = n x (c - b) / 2, and so on around.
#pragma once

#include "vector3.h"

namespace etsplat {

// gradient[k] receives scale times the derivative by corner k; 0 for a triangle without area.
ETSPLAT_FN float area_with_gradient(const Vector3<float>* corner, float scale, Vector3<float>* gradient) {
    const Vector3<float> a = corner[0], b = corner[1], c = corner[2];
    float doubled;
    const Vector3<float> n = direction(cross(b - a, c - a), doubled);
    gradient[0] = 0.5f * scale * cross(n, c - b);
    gradient[1] = 0.5f * scale * cross(n, a - c);
    gradient[2] = 0.5f * scale * cross(n, b - a);
    return 0.5f * doubled;
}

}  // namespace etsplat
