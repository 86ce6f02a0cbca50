// Formulas of antialiased z-buffer rasterization with their derivatives: where a silhouette crosses the line between two
// pixel centres, and how interpolated values change with the corners of their triangle.
//
// The T of the CPU engine is double here: a crossing decides between pixels, and a triangle's view matrix is nearly
// singular where the triangle is small.
#pragma once

#include "vector3.h"

namespace etsplat {

// What has a colour of its own. Between those of vertices or corners, pixels are interpolated.
enum class ColorsOf : int { kFaces, kVertices, kCorners, kPixels };

// Where the line from a to b meets the row (or column) at `across`. Coordinates along it, and across it.
template <class T>
struct Crossing {
    T position;  // along
    T fraction;  // from a (0) to b (1)
    T slope;     // d along / d across
};

template <class T>
ETSPLAT_FN Crossing<T> crossing(T a_along, T a_across, T b_along, T b_across, T across) {
    const T slope = (b_along - a_along) / (b_across - a_across);
    return {a_along + (across - a_across) * slope, (across - a_across) / (b_across - a_across), slope};
}

// d position / d (a_along, a_across, b_along, b_across): moving an end across slides the line along its slope.
template <class T>
ETSPLAT_FN void crossing_derivative(const Crossing<T>& c, T* derivative) {
    derivative[0] = T(1.0f) - c.fraction;
    derivative[1] = T(0.0f) - (T(1.0f) - c.fraction) * c.slope;
    derivative[2] = c.fraction;
    derivative[3] = T(0.0f) - c.fraction * c.slope;
}

// On which side of the line from a to b the point p lies, by its sign.
ETSPLAT_FN double side_of(const double* a, const double* b, const double* p) {
    return (b[0] - a[0]) * (p[1] - a[1]) - (p[0] - a[0]) * (b[1] - a[1]);
}

// What a silhouette does between a pixel and its neighbour at the right (axis 0) or below (axis 1).
struct SilhouetteBlend {
    bool into_second;  // the second pixel gets weight (colour of the first - its own), or the other way round
    float weight;
    float by_along[2], by_across[2];  // its derivative by where the silhouette's ends are along the axis, and across it
};

// The edge from a to b of the nearer triangle, which the first pixel sees if `forward`, beside the line between the centres
// of two pixels. `along` is where the nearer triangle's pixel has its centre, along the axis, `across` where both have it
// across.
struct EdgeCrossing {
    Crossing<double> at;
    double reach;  // from the nearer triangle's pixel
    bool between;  // it is steep enough, and crosses between the centres, if its ends lie on both sides of the line
};

ETSPLAT_FN EdgeCrossing edge_crossing(const double* a, const double* b, int axis, double along, double across,
                                      bool forward) {
    const int other = 1 - axis;
    EdgeCrossing e;
    e.at = crossing(a[axis], a[other], b[axis], b[other], across);
    e.reach = (2.0 * forward - 1.0) * (e.at.position - along);
    e.between = (e.at.slope <= 1.0) & (e.at.slope >= -1.0) & (e.reach >= 0.0) & (e.reach <= 1.0);
    return e;
}

// What an edge that crosses between the centres does.
ETSPLAT_FN SilhouetteBlend blend_of(const EdgeCrossing& e, bool forward) {
    const bool overruns = e.reach > 0.5;  // into the other pixel's half
    SilhouetteBlend blend;
    blend.into_second = overruns == forward;
    blend.weight = static_cast<float>((2.0 * overruns - 1.0) * (e.reach - 0.5));
    const double sign = 2.0 * blend.into_second - 1.0;
    double derivative[4];
    crossing_derivative(e.at, derivative);
    for (int end = 0; end < 2; ++end) {
        blend.by_along[end] = static_cast<float>(sign * derivative[2 * end]);
        blend.by_across[end] = static_cast<float>(sign * derivative[2 * end + 1]);
    }
    return blend;
}

// For the silhouette from a to b, with the arguments of `edge_crossing`. False if it does nothing.
ETSPLAT_FN bool silhouette_blend(const double* a, const double* b, int axis, double along, double across, bool forward,
                                 SilhouetteBlend& blend) {
    const int other = 1 - axis;
    if ((a[other] <= across) == (b[other] <= across)) return false;
    const EdgeCrossing e = edge_crossing(a, b, axis, along, across, forward);
    if (!e.between) return false;
    blend = blend_of(e, forward);
    return true;
}

// A triangle as seen from the camera's centre: its barycentrics at the pixel with ray r are b = beta / sum(beta), where
// V beta = r and V has the corners, relative to the centre, as columns. Row k of V^-1:
template <class T>
struct ViewInverse {
    Vector3<T> row[3];
};

// Rows of 0 for a triangle seen edge on.
template <class T>
ETSPLAT_FN ViewInverse<T> view_inverse(const Vector3<T>* corner) {
    const Vector3<T> normal = cross(corner[1], corner[2]);
    const T determinant = dot(corner[0], normal);
    const T inverse = determinant != T(0.0f) ? T(1.0f) / determinant : T(0.0f);
    return {{inverse * normal, inverse * cross(corner[2], corner[0]), inverse * cross(corner[0], corner[1])}};
}

// With cotangents g_k of b_k: dL/dv_m = -b_m u. From V beta = r follows d beta = -V^-1 dV beta, and from b = beta /
// sum(beta) that u = V^-T (g - sum_j b_j g_j).
template <class T>
ETSPLAT_FN Vector3<T> interpolation_derivative(const ViewInverse<T>& inverse, const T* barycentrics, const T* cotangent) {
    const T mean =
        barycentrics[0] * cotangent[0] + barycentrics[1] * cotangent[1] + barycentrics[2] * cotangent[2];
    return (cotangent[0] - mean) * inverse.row[0] + (cotangent[1] - mean) * inverse.row[1] +
           (cotangent[2] - mean) * inverse.row[2];
}

}  // namespace etsplat
