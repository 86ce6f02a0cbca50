// From three vertices to the linear forms that the tile loops evaluate, and back again for the gradients.
//
// Both distances are x(p) = 1 - min_k w_k a_k(p) with the affine screen-space barycentrics a_k:
//     barycentric  w_k = 3                     sdf  w_k = perimeter / l_k   (l_k: side opposite to vertex k)
// so with q = sum_k v_k / w_k (the mean of the vertices; the incentre) and g_k = -w_k grad a_k,
//     x(p) = max_k g_k . (p - q).
// Moving vertex m by d moves a_k like moving the pixel by -a_m d:  d a_k / d v_m = -a_m grad a_k.
//
// Points are arrays of T; the three vertices of a triangle follow each other.
#pragma once

#include "portable.h"

namespace etsplat {

enum class Distance : int { kBarycentric, kSdf };

struct PinholeCamera {
    float rotation[9], translation[3];  // world to camera, row-major
    float fx, skew, cx, fy, cy;
};

// Of row-major (4, 4) and (3, 3).
ETSPLAT_FN PinholeCamera pinhole_camera(const float* viewmat, const float* K) {
    PinholeCamera camera;
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) camera.rotation[3 * i + j] = viewmat[4 * i + j];
        camera.translation[i] = viewmat[4 * i + 3];
    }
    camera.fx = K[0];
    camera.skew = K[1];
    camera.cx = K[2];
    camera.fy = K[4];
    camera.cy = K[5];
    return camera;
}

template <class T>
struct Triangle2D {
    T x[3], y[3];    // projected vertices, pixels
    T ax[3], ay[3];  // grad a_k
    T area2;         // twice the signed area
    T side[3];       // length opposite to vertex k
    T weight[3];     // w_k
};

template <class T>
ETSPLAT_FN void to_camera(const PinholeCamera& camera, const T* world, T* view) {
    const float* r = camera.rotation;
    for (int i = 0; i < 3; ++i)
        view[i] = T(r[3 * i]) * world[0] + T(r[3 * i + 1]) * world[1] + T(r[3 * i + 2]) * world[2] +
                  T(camera.translation[i]);
}

// Rounded alike in every program and by every engine: a sharp kernel magnifies where in a pixel a corner of a thin triangle is.
template <class T>
ETSPLAT_FN void project(const PinholeCamera& camera, const T* view, T& x, T& y) {
    const T inverse_z = T(1.0f) / view[2];
    const T right = vproduct(T(camera.fx), view[0]) + vproduct(T(camera.skew), view[1]);
    x = vproduct(right, inverse_z) + T(camera.cx);
    y = vproduct(vproduct(T(camera.fy), view[1]), inverse_z) + T(camera.cy);
}

// Completes x, y to the rest. False for a triangle without screen area (docs/conventions.md) or not finite.
template <class T>
ETSPLAT_FN MaskOf<T> set_up(Triangle2D<T>& t, Distance distance) {
    T longest2(0.0f);
    for (int k = 0; k < 3; ++k) {
        const int i = (k + 1) % 3, j = (k + 2) % 3;
        const T ex = t.x[j] - t.x[i], ey = t.y[j] - t.y[i];
        t.side[k] = ex * ex + ey * ey;
        longest2 = vmax(longest2, t.side[k]);
        t.ax[k] = T(0.0f) - ey;
        t.ay[k] = ex;
    }
    t.area2 = t.ay[2] * t.ax[1] - t.ax[2] * t.ay[1];
    const T area = vabs(t.area2);
    const MaskOf<T> valid = (area > vmax(T(1e-6f) * longest2, T(1e-12f))) & (area < T(1e30f)) & (longest2 < T(1e30f));
    const T inverse = T(1.0f) / t.area2;
    for (int k = 0; k < 3; ++k) {
        t.ax[k] = t.ax[k] * inverse;
        t.ay[k] = t.ay[k] * inverse;
        t.side[k] = vsqrt(t.side[k]);
    }
    const T perimeter = t.side[0] + t.side[1] + t.side[2];
    for (int k = 0; k < 3; ++k)
        t.weight[k] = distance == Distance::kBarycentric ? T(3.0f) : perimeter / t.side[k];
    return valid;
}

// World vertices (3, 3) to view vertices (3, 3) and the projected triangle. False where it is not drawn: behind the near
// plane, without screen area, or not finite; nothing else that was computed means anything there.
template <class T>
ETSPLAT_FN MaskOf<T> project_triangle(const PinholeCamera& camera, float near_plane, Distance distance, const T* world,
                                      T* view, Triangle2D<T>& t) {
    MaskOf<T> before = T(0.0f) < T(1.0f);
    for (int k = 0; k < 3; ++k) {
        to_camera(camera, world + 3 * k, view + 3 * k);
        project(camera, view + 3 * k, t.x[k], t.y[k]);
        before = before & (view[3 * k + 2] > T(near_plane)) & (view[3 * k + 2] < T(1e30f)) &
                 (vabs(t.x[k]) < T(1e15f)) & (vabs(t.y[k]) < T(1e15f));
    }
    return before & set_up(t, distance);
}

template <class T>
ETSPLAT_FN T centroid_depth(const T* view) {
    return (view[2] + view[5] + view[8]) / T(3.0f);
}

template <class T>
ETSPLAT_FN T inradius(const Triangle2D<T>& t) {
    return vabs(t.area2) / (t.side[0] + t.side[1] + t.side[2]);
}

// Largest distance of a vertex to the mean of the vertices.
template <class T>
ETSPLAT_FN T screen_size(const Triangle2D<T>& t) {
    const T cx = (t.x[0] + t.x[1] + t.x[2]) / T(3.0f), cy = (t.y[0] + t.y[1] + t.y[2]) / T(3.0f);
    T largest(0.0f);
    for (int k = 0; k < 3; ++k) {
        const T dx = t.x[k] - cx, dy = t.y[k] - cy;
        largest = vmax(largest, dx * dx + dy * dy);
    }
    return vsqrt(largest);
}

// x(p) = max_k g_k . (p - q)
template <class T>
struct DistanceForms {
    T qx, qy;
    T gx[3], gy[3];
};

template <class T>
ETSPLAT_FN DistanceForms<T> distance_forms(const Triangle2D<T>& t) {
    DistanceForms<T> forms;
    // relative to the first vertex, where differences are exact
    forms.qx = ((t.x[1] - t.x[0]) / t.weight[1] + (t.x[2] - t.x[0]) / t.weight[2]) + t.x[0];
    forms.qy = ((t.y[1] - t.y[0]) / t.weight[1] + (t.y[2] - t.y[0]) / t.weight[2]) + t.y[0];
    for (int k = 0; k < 3; ++k) {
        forms.gx[k] = T(0.0f) - t.weight[k] * t.ax[k];
        forms.gy[k] = T(0.0f) - t.weight[k] * t.ay[k];
    }
    return forms;
}

// Bounding box of {x <= extent}, relative to q.
template <class T>
struct SupportBox {
    T left, right, top, bottom;
};

template <class T>
ETSPLAT_FN SupportBox<T> support_box(const Triangle2D<T>& t, T qx, T qy, T extent) {
    const T x0 = t.x[0] - qx, x1 = t.x[1] - qx, x2 = t.x[2] - qx;
    const T y0 = t.y[0] - qy, y1 = t.y[1] - qy, y2 = t.y[2] - qy;
    return {extent * vmin(x0, vmin(x1, x2)), extent * vmax(x0, vmax(x1, x2)), extent * vmin(y0, vmin(y1, y2)),
            extent * vmax(y0, vmax(y1, y2))};
}

template <class T>
ETSPLAT_FN MaskOf<T> meets_image(const SupportBox<T>& box, T qx, T qy, int width, int height) {
    return (qx + box.right >= T(0.0f)) & (qx + box.left <= T(static_cast<float>(width))) &
           (qy + box.bottom >= T(0.0f)) & (qy + box.top <= T(static_cast<float>(height)));
}

// Adds to grad_x/y[m] the gradient of sum over pixels of (cotangent of a_k), given for each k the moments
// s[k] = sum cotangent and (rx, ry)[k] = sum cotangent (p - o), and a_m(o) of the point o.
template <class T>
ETSPLAT_FN void barycentric_backward(const Triangle2D<T>& t, const T* a_at_origin, const T* s, const T* rx, const T* ry,
                                     T* grad_x, T* grad_y) {
    for (int m = 0; m < 3; ++m)
        for (int k = 0; k < 3; ++k) {
            const T weighted = a_at_origin[m] * s[k] + t.ax[m] * rx[k] + t.ay[m] * ry[k];  // sum cotangent a_m
            grad_x[m] = grad_x[m] - t.ax[k] * weighted;
            grad_y[m] = grad_y[m] - t.ay[k] * weighted;
        }
}

// Gradient by the projected vertices, from the moments about q of the gradients by the forms f_k = g_k . (p - q), and those
// by log w_k on its own. freeze_inradius treats the inradius as a constant, as Triangle Splatting does.
template <class T>
ETSPLAT_FN void distance_backward(const Triangle2D<T>& t, Distance distance, bool freeze_inradius, const T* s,
                                  const T* rx, const T* ry, const T* log_weight, T* grad_x, T* grad_y) {
    T a_at_q[3], cs[3], cx[3], cy[3];
    for (int k = 0; k < 3; ++k) {
        a_at_q[k] = T(1.0f) / t.weight[k];
        cs[k] = T(0.0f) - t.weight[k] * s[k];
        cx[k] = T(0.0f) - t.weight[k] * rx[k];
        cy[k] = T(0.0f) - t.weight[k] * ry[k];
    }
    barycentric_backward(t, a_at_q, cs, cx, cy, grad_x, grad_y);
    if (distance == Distance::kBarycentric) return;

    const T perimeter = t.side[0] + t.side[1] + t.side[2];
    T grad_weight[3], shared(0.0f);
    for (int k = 0; k < 3; ++k) {
        grad_weight[k] = T(0.0f) - (a_at_q[k] * (s[k] - log_weight[k]) + t.ax[k] * rx[k] + t.ay[k] * ry[k]);
        shared = shared + grad_weight[k] / t.side[k];
    }
    for (int k = 0; k < 3; ++k) {
        const int i = (k + 1) % 3, j = (k + 2) % 3;
        T grad_side = T(0.0f) - grad_weight[k] * t.weight[k] / t.side[k];
        if (!freeze_inradius) grad_side = grad_side + shared;  // w_k = perimeter / l_k
        const T scale = grad_side / t.side[k];
        const T ux = (t.x[i] - t.x[j]) * scale, uy = (t.y[i] - t.y[j]) * scale;
        grad_x[i] = grad_x[i] + ux;
        grad_y[i] = grad_y[i] + uy;
        grad_x[j] = grad_x[j] - ux;
        grad_y[j] = grad_y[j] - uy;
        if (freeze_inradius) {  // w_k = |2A| / (l_k r) with r constant, and d|2A| / d v_k = |2A| grad a_k
            grad_x[k] = grad_x[k] + shared * perimeter * t.ax[k];
            grad_y[k] = grad_y[k] + shared * perimeter * t.ay[k];
        }
    }
}

// Adds the gradient of a projected vertex to its camera-space gradient.
template <class T>
ETSPLAT_FN void project_backward(const PinholeCamera& camera, const T* view, T x, T y, T grad_x, T grad_y, T* grad_view) {
    const T inverse_z = T(1.0f) / view[2];
    grad_view[0] = grad_view[0] + grad_x * T(camera.fx) * inverse_z;
    grad_view[1] = grad_view[1] + (grad_x * T(camera.skew) + grad_y * T(camera.fy)) * inverse_z;
    grad_view[2] = grad_view[2] - (grad_x * (x - T(camera.cx)) + grad_y * (y - T(camera.cy))) * inverse_z;
}

// Numbers of a camera's gradient: 12 by the rows [rotation | translation], then by fx, cx, fy, cy.
constexpr int kCameraGradients = 16;
constexpr int kIntrinsicsPlace[4] = {0, 2, 4, 5};  // of the last four in a row-major (3, 3)

// A triangle's part of it: add(j, a, b) adds a[0] b[0] + a[1] b[1] + a[2] b[2] to number j.
// world, view: its vertices (3, 3) there, grad_view by the latter; gx, gy by its projected vertices (3).
template <class T, class Add>
ETSPLAT_FN void camera_gradient(const T* world, const T* view, const T* grad_view, const T* gx, const T* gy, const Add& add) {
    const T one[3] = {T(1.0f), T(1.0f), T(1.0f)};
    for (int row = 0; row < 3; ++row) {
        const T grad[3] = {grad_view[row], grad_view[3 + row], grad_view[6 + row]};
        for (int column = 0; column < 3; ++column) {
            const T position[3] = {world[column], world[3 + column], world[6 + column]};
            add(4 * row + column, grad, position);
        }
        add(4 * row + 3, grad, one);
    }
    T x[3], y[3];  // on the plane z = 1
    for (int k = 0; k < 3; ++k) {
        x[k] = view[3 * k] / view[3 * k + 2];
        y[k] = view[3 * k + 1] / view[3 * k + 2];
    }
    add(12, gx, x);
    add(13, gx, one);
    add(14, gy, y);
    add(15, gy, one);
}

template <class T>
ETSPLAT_FN void to_world_gradient(const PinholeCamera& camera, const T* grad_view, T* grad_world) {
    const float* r = camera.rotation;
    for (int j = 0; j < 3; ++j)
        grad_world[j] = T(r[j]) * grad_view[0] + T(r[3 + j]) * grad_view[1] + T(r[6 + j]) * grad_view[2];
}

}  // namespace etsplat
