// Element formulas of the mesh energies L_e, L_n, L_lap (paper, section 3.3) with their derivatives.
//
// Lengths and areas too small to have a direction give zero gradient: lengths up to kMinLength, faces whose doubled
// area is at most kMinShape times their longest edge squared (below that the float32 cross product is rounding noise).
#pragma once

#include "vector3.h"

namespace etsplat {

constexpr float kMinShape = 1e-6f;
constexpr float kMaxSquare = 3e38f;

// |a - b|^Power and its derivative by a.
template <int Power, class T>
ETSPLAT_FN Vector3<T> edge_energy(Vector3<T> a, Vector3<T> b, T& value) {
    static_assert(Power == 1 || Power == 2);
    const Vector3<T> d = a - b;
    if constexpr (Power == 1) {
        return direction(d, value);
    } else {
        value = dot(d, d);
        return T(2.0f) * d;
    }
}

template <class T>
struct FaceNormal {
    Vector3<T> unit;
    T inverse_norm;  // 1 / |(b - a) x (c - a)|; both 0 for a degenerate face
};

template <class T>
ETSPLAT_FN FaceNormal<T> face_normal(Vector3<T> a, Vector3<T> b, Vector3<T> c) {
    const Vector3<T> u = b - a, v = c - a, w = c - b;
    const Vector3<T> n = cross(u, v);
    const T square = dot(n, n), longest = vmax(dot(u, u), vmax(dot(v, v), dot(w, w)));
    const T floor = T(kMinShape) * longest;
    const bool usable = square > floor * floor && square < T(kMaxSquare);
    if (!usable) return {{T(0.0f), T(0.0f), T(0.0f)}, T(0.0f)};
    const T inverse = T(1.0f) / vsqrt(square);
    return {inverse * n, inverse};
}

// 1 - n0 . n1 = |n1 - n0|^2 / 2 (exact where the normals nearly agree), 0 if a face is degenerate; and its derivative
// by the cross product that n0 is the direction of.
template <class T>
ETSPLAT_FN Vector3<T> normal_energy(const FaceNormal<T>& f0, const FaceNormal<T>& f1, T& value) {
    const bool usable = f0.inverse_norm > T(0.0f) && f1.inverse_norm > T(0.0f);
    const Vector3<T> d = f1.unit - f0.unit;
    value = usable ? T(0.5f) * dot(d, d) : T(0.0f);
    const T scale = usable ? f0.inverse_norm : T(0.0f);
    return scale * (dot(d, f0.unit) * f0.unit - d);
}

// From the derivative g by (b - a) x (c - a) to those by b and c; the one by a is minus their sum.
template <class T>
ETSPLAT_FN void cross_backward(Vector3<T> a, Vector3<T> b, Vector3<T> c, Vector3<T> g, Vector3<T>& by_b,
                               Vector3<T>& by_c) {
    by_b = cross(c - a, g);
    by_c = cross(g, b - a);
}

}  // namespace etsplat
