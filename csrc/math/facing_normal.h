// Depth of a triangle's centroid and its unit normal, turned to the camera (etsplat/ops/triangle_channels.py).
#pragma once

#include "vector3.h"

namespace etsplat {

// Of the camera: its third row of world to camera, and its centre.
struct DepthAxis {
    Vector3<float> axis;
    float offset;
    Vector3<float> center;
};

// All 0 where the camera is not finite: it sees nothing, and must not spoil the gradients of the others.
ETSPLAT_FN DepthAxis depth_axis(const float* viewmat) {
    float center[3] = {0.0f, 0.0f, 0.0f}, nought = 0.0f;
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) center[j] -= viewmat[4 * i + j] * viewmat[4 * i + 3];
        for (int j = 0; j < 4; ++j) nought += viewmat[4 * i + j] - viewmat[4 * i + j];
    }
    if (nought != 0.0f) return {};
    return {{viewmat[8], viewmat[9], viewmat[10]}, viewmat[11], {center[0], center[1], center[2]}};
}

ETSPLAT_FN bool all_finite(const Vector3<float>* corner) {
    float nought = 0.0f;
    for (int k = 0; k < 3; ++k) {
        const Vector3<float> difference = corner[k] - corner[k];
        nought += difference.x + difference.y + difference.z;
    }
    return nought == 0.0f;
}

ETSPLAT_FN Vector3<float> centroid_of(const Vector3<float>* corner) {
    // a sum before the division could be infinite
    return (1.0f / 3.0f) * corner[0] + (1.0f / 3.0f) * corner[1] + (1.0f / 3.0f) * corner[2];
}

ETSPLAT_FN float centroid_depth(const DepthAxis& camera, const Vector3<float>* corner) {
    return dot(camera.axis, centroid_of(corner)) + camera.offset;
}

// Edges from corner 0, brought near 1 first: the squares of very long or short ones leave the range of float.
struct ScaledEdges {
    Vector3<float> first, second;
    float inverse_size;  // 0 where there is no direction
};

ETSPLAT_FN ScaledEdges scaled_edges(const Vector3<float>* corner) {
    const Vector3<float> a = corner[1] - corner[0], b = corner[2] - corner[0];
    const float size = vmax(vmax(vmax(vabs(a.x), vabs(a.y)), vmax(vabs(a.z), vabs(b.x))), vmax(vabs(b.y), vabs(b.z)));
    if (!(size > 0.0f && size < 3e38f)) return {};  // corners may be finite and edges not
    const float inverse = 1.0f / size;
    return {inverse * a, inverse * b, inverse};
}

// 0 for a triangle without area.
ETSPLAT_FN Vector3<float> facing_normal(const DepthAxis& camera, const Vector3<float>* corner, float& inverse_length) {
    const ScaledEdges e = scaled_edges(corner);
    const Vector3<float> across = cross(e.first, e.second);
    const float square = dot(across, across);
    inverse_length = square > 0.0f ? 1.0f / vsqrt(square) : 0.0f;
    const Vector3<float> normal = inverse_length * across;
    return dot(centroid_of(corner) - camera.center, normal) > 0.0f ? -1.0f * normal : normal;
}

// Channels of a triangle for one camera: depth and normal, those that are wanted. 0 for one that is not finite.
ETSPLAT_FN void triangle_channels(const DepthAxis& camera, const Vector3<float>* corner, bool depth, bool normal,
                                  float* channels) {
    const bool finite = all_finite(corner);
    if (depth) *channels++ = finite ? centroid_depth(camera, corner) : 0.0f;
    if (!normal) return;
    float inverse_length;
    const Vector3<float> n = finite ? facing_normal(camera, corner, inverse_length) : Vector3<float>{};
    channels[0] = n.x;
    channels[1] = n.y;
    channels[2] = n.z;
}

// Adds what a gradient by the facing normal is by the corners.
ETSPLAT_FN void facing_normal_backward(const DepthAxis& camera, const Vector3<float>* corner, Vector3<float> grad,
                                       Vector3<float>* grad_corner) {
    const ScaledEdges e = scaled_edges(corner);
    float inverse_length;
    const Vector3<float> facing = facing_normal(camera, corner, inverse_length);
    const Vector3<float> across = cross(e.first, e.second);
    const float sign = dot(facing, across) < 0.0f ? -1.0f : 1.0f;
    const Vector3<float> by_across = (sign * inverse_length * e.inverse_size) * (grad - dot(grad, facing) * facing);
    const Vector3<float> by_first = cross(e.second, by_across), by_second = cross(by_across, e.first);
    grad_corner[1] = grad_corner[1] + by_first;
    grad_corner[2] = grad_corner[2] + by_second;
    grad_corner[0] = grad_corner[0] - (by_first + by_second);
}

// Adds what gradients by the channels are by the corners.
ETSPLAT_FN void triangle_channels_backward(const DepthAxis& camera, const Vector3<float>* corner, bool depth,
                                           bool normal, const float* grad, Vector3<float>* grad_corner) {
    if (!all_finite(corner)) return;
    if (depth) {
        const Vector3<float> share = (*grad++ * (1.0f / 3.0f)) * camera.axis;
        for (int k = 0; k < 3; ++k) grad_corner[k] = grad_corner[k] + share;
    }
    if (normal) facing_normal_backward(camera, corner, {grad[0], grad[1], grad[2]}, grad_corner);
}

}  // namespace etsplat
