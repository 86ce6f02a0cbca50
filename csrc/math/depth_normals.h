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

    ETSPLAT_FN float ray_x(float column) const { return (column + 0.5f - cx) * inverse_fx; }
    ETSPLAT_FN float ray_y(float row) const { return (row + 0.5f - cy) * inverse_fy; }

    ETSPLAT_FN Vector3<float> to_camera(Vector3<float> v) const {
        const float* r = rotation;
        return {r[0] * v.x + r[1] * v.y + r[2] * v.z, r[3] * v.x + r[4] * v.y + r[5] * v.z,
                r[6] * v.x + r[7] * v.y + r[8] * v.z};
    }
    ETSPLAT_FN Vector3<float> to_world(Vector3<float> v) const {
        const float* r = rotation;
        return {r[0] * v.x + r[3] * v.y + r[6] * v.z, r[1] * v.x + r[4] * v.y + r[7] * v.z,
                r[2] * v.x + r[5] * v.y + r[8] * v.z};
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
struct DepthCross {
    float above, below, left, right;
};

struct DepthSlopes {
    Vector3<float> down, right;
};

// Of the points in the camera's axes.
ETSPLAT_FN DepthSlopes depth_slopes(const DepthView& view, DepthCross z, float row, float column) {
    const float x = view.ray_x(column), y = view.ray_y(row);
    return {{x * (z.below - z.above), view.ray_y(row + 1.0f) * z.below - view.ray_y(row - 1.0f) * z.above,
             z.below - z.above},
            {view.ray_x(column + 1.0f) * z.right - view.ray_x(column - 1.0f) * z.left, y * (z.right - z.left),
             z.right - z.left}};
}

struct Agreement {
    float value;
    Vector3<float> by_normal;  // in the world
    DepthSlopes by_slopes;
};

ETSPLAT_FN Agreement agreement(const DepthView& view, DepthSlopes slopes, Vector3<float> normal, float alpha) {
    const Vector3<float> across = cross(slopes.down, slopes.right);
    const float square = dot(across, across);
    const float inverse = square > 0.0f ? 1.0f / vsqrt(square) : 0.0f;
    const Vector3<float> unit = inverse * across, toward = alpha * view.to_camera(normal);
    const float value = dot(toward, unit);
    const Vector3<float> by_across = inverse * (toward - value * unit);
    return {value, view.to_world(alpha * unit), {cross(slopes.right, by_across), cross(by_across, slopes.down)}};
}

// Derivative by the depth at (row, column), from those by the differences that it takes part in.
ETSPLAT_FN float along_ray(const DepthView& view, Vector3<float> by_point, float row, float column) {
    return view.ray_x(column) * by_point.x + view.ray_y(row) * by_point.y + by_point.z;
}

}  // namespace etsplat
