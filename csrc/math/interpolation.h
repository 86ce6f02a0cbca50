// What is interpolated over a triangle, the distortion, and the derivatives of both at one pixel.
//
// Attributes have perspective-correct weights b_k = max(a_k, 0) / z_k / U with U = sum max(a_k, 0) / z_k, and the plane's
// depth is z = A / U with A = sum max(a_k, 0). The distortion sum_{i<j} w_i w_j (m_i - m_j)^2 needs W = sum w, M = sum w m
// and Q = sum w m^2 alone.
#pragma once

#include "raster_records.h"
#include "triangle.h"

namespace etsplat {

template <class T>
struct Interpolation {
    T clamped[3];  // max(a_k, 0)
    MaskOf<T> positive[3];
    T inverse_z_sum;  // U
    T sum;            // A
    T weight[3];      // b_k

    // At the pixel q + (dx, dy).
    ETSPLAT_FN void evaluate(const AttributeRecord& record, T dx, T dy) {
        const T x = dx + T(record.offset_x), y = dy + T(record.offset_y);
        sum = T(0.0f);
        inverse_z_sum = T(0.0f);
        for (int k = 0; k < 3; ++k) {
            const T a = vfma(T(record.ax[k]), x, vfma(T(record.ay[k]), y, T(1.0f / 3.0f)));
            positive[k] = a > T(0.0f);
            clamped[k] = vmax(a, T(0.0f));
            weight[k] = clamped[k] * T(record.inverse_z[k]);
            sum = sum + clamped[k];
            inverse_z_sum = inverse_z_sum + weight[k];
        }
        for (int k = 0; k < 3; ++k) weight[k] = weight[k] / inverse_z_sum;
    }
    ETSPLAT_FN T depth() const { return sum / inverse_z_sum; }
};

// Gradients of one pixel by what Interpolation computed from.
template <class T>
struct InterpolationGradient {
    T inverse_z[3];    // dL/d(1/z_k)
    T barycentric[3];  // dL/d a_k

    // w: blend weight; grad_value[k]: sum over channels of cotangent times the colour of corner k; grad_depth: dL/d(1/z) of
    // the plane's depth z, inverse_z = 1/z.
    ETSPLAT_FN void evaluate(const AttributeRecord& record, const Interpolation<T>& at, T w, const T* grad_value,
                             bool with_depth, T grad_depth, T plane_inverse_z) {
        T mean(0.0f);
        for (int k = 0; k < 3; ++k) mean = vfma(at.weight[k], grad_value[k], mean);
        for (int k = 0; k < 3; ++k) {
            T grad_product = w * (grad_value[k] - mean) / at.inverse_z_sum;  // of max(a_k, 0) / z_k
            T grad_clamped(0.0f);
            if (with_depth) {
                grad_product = grad_product + grad_depth / at.sum;
                grad_clamped = T(0.0f) - grad_depth * plane_inverse_z / at.sum;
            }
            inverse_z[k] = grad_product * at.clamped[k];
            barycentric[k] =
                vselect(at.positive[k], vfma(grad_product, T(record.inverse_z[k]), grad_clamped), T(0.0f));
        }
    }
};

// m = far / (far - near) (1 - near / z), less its value at the depth 1 / first_inverse_z: the distortion sees differences
// only, and small numbers keep them precise.
template <class T>
ETSPLAT_FN T distortion_coordinate(float near, float far, float first_inverse_z, T inverse_z) {
    return T(-far / (far - near) * near) * (inverse_z - T(first_inverse_z));
}
// m^2 W + Q - 2 m M: what a unit of weight at m adds to the distortion, from the totals of what it is paired with.
template <class T>
ETSPLAT_FN T distortion_spread(T m, T total_weight, T total_first, T total_second) {
    return vfma(m * m, total_weight, total_second) - T(2.0f) * m * total_first;
}
// Derivative of the distortion by 1/z of a triangle with blend weight w, from the totals of the whole ray.
template <class T>
ETSPLAT_FN T distortion_slope(float near, float far, T m, T w, T total_weight, T total_first) {
    const float dm = -near * far / (far - near);
    return T(2.0f * dm) * w * (m * total_weight - total_first);
}

// Camera-space gradient (3, 3) of the vertices of a triangle from its sums over pixels, sums[j] at SlotLayout's place j.
template <class T, class Sums>
ETSPLAT_FN void view_gradient(const PinholeCamera& camera, Distance distance, bool freeze_incentre,
                              const SlotLayout& layout, const Sums& sums, const T* view, const Triangle2D<T>& t,
                              T* grad_view) {
    T gx[3], gy[3], s[3], rx[3], ry[3];
    const auto moments = [&](int first) {
        for (int k = 0; k < 3; ++k) {
            s[k] = sums[first + k];
            rx[k] = sums[first + 3 + k];
            ry[k] = sums[first + 6 + k];
        }
    };
    for (int k = 0; k < 3; ++k) gx[k] = gy[k] = T(0.0f);
    for (int k = 0; k < 9; ++k) grad_view[k] = T(0.0f);
    moments(SlotLayout::kMoment);
    distance_backward(t, distance, freeze_incentre, s, rx, ry, gx, gy);
    if (layout.attributes) {
        const DistanceForms<T> forms = distance_forms(t);
        T offset_x, offset_y, a_at_q[3];
        offset_from_mean(t, forms.qx, forms.qy, offset_x, offset_y);
        for (int m = 0; m < 3; ++m) a_at_q[m] = T(1.0f / 3.0f) + t.ax[m] * offset_x + t.ay[m] * offset_y;
        moments(layout.barycentric());
        barycentric_backward(t, a_at_q, s, rx, ry, gx, gy);
        for (int k = 0; k < 3; ++k) {
            const T inverse_z = T(1.0f) / view[3 * k + 2];
            grad_view[3 * k + 2] = grad_view[3 * k + 2] - sums[layout.inverse_z() + k] * inverse_z * inverse_z;
        }
    }
    if (layout.centroid_z)
        for (int k = 0; k < 3; ++k) grad_view[3 * k + 2] = grad_view[3 * k + 2] + sums[layout.depth()] / T(3.0f);
    for (int k = 0; k < 3; ++k)
        project_backward(camera, view + 3 * k, t.x[k], t.y[k], gx[k], gy[k], grad_view + 3 * k);
}

}  // namespace etsplat
