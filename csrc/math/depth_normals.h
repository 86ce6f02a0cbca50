// Agreement of a normal with that of the depth image at one pixel (etsplat/ops/normal_consistency.py).
//
// With P the points of the depth image in the camera's axes, m = normalize(d_rows P x d_columns P), both differences
// central, and R the rotation into the camera: alpha <R n, m>. Differences that span no plane give 0.
#pragma once

#include "vector3.h"

namespace etsplat {

// Rays of depth 1 through pixel centres, and the rotation from world to camera.
struct DepthView {
    float rotation[9], inverse_fx, inverse_fy, cx, cy;

    template <class T>
    ETSPLAT_FN T ray_x(T column) const {
        return (column + T(0.5f - cx)) * T(inverse_fx);
    }
    template <class T>
    ETSPLAT_FN T ray_y(T row) const {
        return (row + T(0.5f - cy)) * T(inverse_fy);
    }
    template <class T>
    ETSPLAT_FN Vector3<T> to_camera(Vector3<T> v) const {
        const float* r = rotation;
        return {T(r[0]) * v.x + T(r[1]) * v.y + T(r[2]) * v.z, T(r[3]) * v.x + T(r[4]) * v.y + T(r[5]) * v.z,
                T(r[6]) * v.x + T(r[7]) * v.y + T(r[8]) * v.z};
    }
    template <class T>
    ETSPLAT_FN Vector3<T> to_world(Vector3<T> v) const {
        const float* r = rotation;
        return {T(r[0]) * v.x + T(r[3]) * v.y + T(r[6]) * v.z, T(r[1]) * v.x + T(r[4]) * v.y + T(r[7]) * v.z,
                T(r[2]) * v.x + T(r[5]) * v.y + T(r[8]) * v.z};
    }
};

ETSPLAT_FN DepthView depth_view(const float* viewmat, const float* K) {
    DepthView view;
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) view.rotation[3 * i + j] = viewmat[4 * i + j];
    }
    view.inverse_fx = 1.0f / K[0];
    view.inverse_fy = 1.0f / K[4];
    view.cx = K[2];
    view.cy = K[5];
    return view;
}

// Depths of the four neighbours of a pixel.
template <class T>
struct DepthCross {
    T above, below, left, right;
};

template <class T>
struct DepthSlopes {
    Vector3<T> down, right;
};

// Of the points in the camera's axes.
template <class T>
ETSPLAT_FN DepthSlopes<T> depth_slopes(const DepthView& view, const DepthCross<T>& z, T row, T column) {
    const T x = view.ray_x(column), y = view.ray_y(row), one(1.0f);
    return {{x * (z.below - z.above), view.ray_y(row + one) * z.below - view.ray_y(row - one) * z.above,
             z.below - z.above},
            {view.ray_x(column + one) * z.right - view.ray_x(column - one) * z.left, y * (z.right - z.left),
             z.right - z.left}};
}

template <class T>
struct Agreement {
    T value;
    Vector3<T> by_normal;  // in the world
    DepthSlopes<T> by_slopes;
};

template <class T>
ETSPLAT_FN Agreement<T> agreement(const DepthView& view, const DepthSlopes<T>& slopes, Vector3<T> normal, T alpha) {
    const Vector3<T> across = cross(slopes.down, slopes.right);
    const T square = dot(across, across);
    const T inverse = vselect(square > T(0.0f), T(1.0f) / vsqrt(vmax(square, T(1e-38f))), T(0.0f));
    const Vector3<T> unit = inverse * across, toward = alpha * view.to_camera(normal);
    const T value = dot(toward, unit);
    const Vector3<T> by_across = inverse * (toward - value * unit);
    return {value, view.to_world(alpha * unit), {cross(slopes.right, by_across), cross(by_across, slopes.down)}};
}

// Derivative by the depth at (row, column), from those by the differences that it takes part in.
ETSPLAT_FN float along_ray(const DepthView& view, Vector3<float> by_point, float row, float column) {
    return view.ray_x(column) * by_point.x + view.ray_y(row) * by_point.y + by_point.z;
}

}  // namespace etsplat
