// Signs of orientation determinants, exact for all finite coordinates whose triple products neither overflow nor
// underflow (magnitudes between about 1e-90 and 1e90, or zero).
//
// A floating-point value with a forward error bound decides nearly all cases; the rest is summed without rounding as a
// multi-term expansion. Method: J. R. Shewchuk, "Adaptive Precision Floating-Point Arithmetic and Fast Robust Geometric
// Predicates", 1997. Needs unfused, correctly rounded double arithmetic (-ffp-contract=off, /fp:precise).
#pragma once

#include "vec3.h"

namespace etsplat {

struct Vec2 {
    double x, y;
};

// Sign (-1, 0, 1) of (a - c) x (b - c): 1 if a, b, c turn counter-clockwise.
int orient2d(Vec2 a, Vec2 b, Vec2 c);

// Sign of det[a - d; b - d; c - d]: which side of the plane through a, b, c the point d is on.
int orient3d(Vec3 a, Vec3 b, Vec3 c, Vec3 d);

}  // namespace etsplat
