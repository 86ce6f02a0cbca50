// From three vertices to the linear forms that the tile loops evaluate, and back again for the gradients.
//
// Both distances are x(p) = 1 - min_k w_k a_k(p) with the affine screen-space barycentrics a_k:
//     barycentric  w_k = 3                     sdf  w_k = perimeter / l_k   (l_k: side opposite to vertex k)
// so with q = sum_k v_k / w_k (the mean of the vertices; the incentre) and g_k = -w_k grad a_k,
//     x(p) = max_k g_k . (p - q).
// Moving vertex m by d moves a_k like moving the pixel by -a_m d:  d a_k / d v_m = -a_m grad a_k.
#pragma once

#include "portable.h"

namespace etsplat {

enum class Distance : int { kBarycentric, kSdf };

struct PinholeCamera {
    float rotation[9], translation[3];  // world to camera, row-major
    float fx, skew, cx, fy, cy;
};

struct Triangle2D {
    float x[3], y[3];      // projected vertices, pixels
    float ax[3], ay[3];    // grad a_k
    float area2;           // twice the signed area
    float side[3];         // length opposite to vertex k
    float weight[3];       // w_k
};

ETSPLAT_FN void to_camera(const PinholeCamera& camera, const float* world, float* view) {
    const float* r = camera.rotation;
    for (int i = 0; i < 3; ++i)
        view[i] = r[3 * i] * world[0] + r[3 * i + 1] * world[1] + r[3 * i + 2] * world[2] + camera.translation[i];
}

ETSPLAT_FN void project(const PinholeCamera& camera, const float* view, float& x, float& y) {
    const float inverse_z = 1.0f / view[2];
    x = (camera.fx * view[0] + camera.skew * view[1]) * inverse_z + camera.cx;
    y = camera.fy * view[1] * inverse_z + camera.cy;
}

// Completes x, y to the rest. Returns false for a triangle without screen area (docs/conventions.md) or not finite.
ETSPLAT_FN bool set_up(Triangle2D& t, Distance distance) {
    float longest2 = 0.0f;
    for (int k = 0; k < 3; ++k) {
        const int i = (k + 1) % 3, j = (k + 2) % 3;
        const float ex = t.x[j] - t.x[i], ey = t.y[j] - t.y[i];
        t.side[k] = ex * ex + ey * ey;
        longest2 = vmax(longest2, t.side[k]);
        t.ax[k] = -ey;
        t.ay[k] = ex;
    }
    t.area2 = t.ay[2] * t.ax[1] - t.ax[2] * t.ay[1];
    const float area = vabs(t.area2);
    if (!(area > vmax(1e-6f * longest2, 1e-12f)) || !(area < 1e30f) || !(longest2 < 1e30f)) return false;
    const float inverse = 1.0f / t.area2;
    float perimeter = 0.0f;
    for (int k = 0; k < 3; ++k) {
        t.ax[k] *= inverse;
        t.ay[k] *= inverse;
        t.side[k] = vsqrt(t.side[k]);
        perimeter += t.side[k];
    }
    for (int k = 0; k < 3; ++k) t.weight[k] = distance == Distance::kBarycentric ? 3.0f : perimeter / t.side[k];
    return true;
}

ETSPLAT_FN float inradius(const Triangle2D& t) { return vabs(t.area2) / (t.side[0] + t.side[1] + t.side[2]); }

// Adds to grad_x/y[m] the gradient of sum over pixels of (cotangent of a_k), given for each k the moments
// s[k] = sum cotangent and (rx, ry)[k] = sum cotangent (p - o), and a_m(o) of the point o.
ETSPLAT_FN void barycentric_backward(const Triangle2D& t, const float* a_at_origin, const float* s, const float* rx,
                                     const float* ry, float* grad_x, float* grad_y) {
    for (int m = 0; m < 3; ++m)
        for (int k = 0; k < 3; ++k) {
            const float weighted = a_at_origin[m] * s[k] + t.ax[m] * rx[k] + t.ay[m] * ry[k];  // sum cotangent a_m
            grad_x[m] -= t.ax[k] * weighted;
            grad_y[m] -= t.ay[k] * weighted;
        }
}

// Gradient of sum over pixels of dx x(p) with respect to the projected vertices, from the moments of dx about q, split
// by the form that is largest. freeze_incentre treats the inradius as a constant, as Triangle Splatting does.
ETSPLAT_FN void distance_backward(const Triangle2D& t, Distance distance, bool freeze_incentre, const float* s,
                                  const float* rx, const float* ry, float* grad_x, float* grad_y) {
    float a_at_q[3], cs[3], cx[3], cy[3];
    for (int k = 0; k < 3; ++k) {
        a_at_q[k] = 1.0f / t.weight[k];
        cs[k] = -t.weight[k] * s[k];
        cx[k] = -t.weight[k] * rx[k];
        cy[k] = -t.weight[k] * ry[k];
    }
    barycentric_backward(t, a_at_q, cs, cx, cy, grad_x, grad_y);
    if (distance == Distance::kBarycentric) return;

    float grad_side[3], grad_area = 0.0f, shared = 0.0f;
    const float perimeter = t.side[0] + t.side[1] + t.side[2], area = vabs(t.area2);
    float grad_weight[3];
    for (int k = 0; k < 3; ++k) {
        grad_weight[k] = -(a_at_q[k] * s[k] + t.ax[k] * rx[k] + t.ay[k] * ry[k]);
        shared += grad_weight[k] / t.side[k];
    }
    for (int k = 0; k < 3; ++k) {
        grad_side[k] = -grad_weight[k] * t.weight[k] / t.side[k];
        if (!freeze_incentre) grad_side[k] += shared;  // w_k = perimeter / l_k
    }
    if (freeze_incentre) grad_area = shared * perimeter / area;  // w_k = |2A| / (l_k r) with r constant
    for (int k = 0; k < 3; ++k) {
        const int i = (k + 1) % 3, j = (k + 2) % 3;
        const float scale = grad_side[k] / t.side[k];
        const float ux = (t.x[i] - t.x[j]) * scale, uy = (t.y[i] - t.y[j]) * scale;
        grad_x[i] += ux;
        grad_y[i] += uy;
        grad_x[j] -= ux;
        grad_y[j] -= uy;
        // d|2A| / d v_k = |2A| grad a_k
        grad_x[k] += grad_area * area * t.ax[k];
        grad_y[k] += grad_area * area * t.ay[k];
    }
}

// Adds the gradient of a projected vertex to its camera-space gradient.
ETSPLAT_FN void project_backward(const PinholeCamera& camera, const float* view, float x, float y, float grad_x,
                                 float grad_y, float* grad_view) {
    const float inverse_z = 1.0f / view[2];
    grad_view[0] += grad_x * camera.fx * inverse_z;
    grad_view[1] += (grad_x * camera.skew + grad_y * camera.fy) * inverse_z;
    grad_view[2] -= (grad_x * (x - camera.cx) + grad_y * (y - camera.cy)) * inverse_z;
}

ETSPLAT_FN void to_world_gradient(const PinholeCamera& camera, const float* grad_view, float* grad_world) {
    const float* r = camera.rotation;
    for (int j = 0; j < 3; ++j)
        grad_world[j] = r[j] * grad_view[0] + r[3 + j] * grad_view[1] + r[6 + j] * grad_view[2];
}

}  // namespace etsplat
