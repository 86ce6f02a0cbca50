// What is interpolated over a triangle, the distortion, and the derivatives of both at one pixel.
//
// Attributes have perspective-correct weights b_k = max(a_k, 0) / z_k / U with U = sum max(a_k, 0) / z_k, and the plane's
// depth is z = A / U with A = sum max(a_k, 0). The tile loops have the linear forms f_k of the distance at hand, and both
// distances are such that a_k = (1 - f_k) / w_k. So the gradients by f_k join those of the distance; that a_k does not
// depend on w_k is made good by dL/d log w_k, in view_gradient.
// The distortion sum_{i<j} w_i w_j (m_i - m_j)^2 needs W = sum w, M = sum w m and Q = sum w m^2 alone.
#pragma once

#include "raster_records.h"
#include "triangle.h"

namespace etsplat {

template <class T>
struct Interpolation {
    T clamped[3];  // max(1 - f_k, 0)
    MaskOf<T> positive[3];
    T product[3];     // max(a_k, 0) / z_k = b_k U
    T inverse_z_sum;  // U
    T inverse;        // 1 / U
    T sum;            // A

    ETSPLAT_FN void evaluate(const AttributeRecord& record, const T form[3]) {
        sum = T(0.0f);
        inverse_z_sum = T(0.0f);
        for (int k = 0; k < 3; ++k) {
            positive[k] = form[k] < T(1.0f);
            clamped[k] = vmax(T(1.0f) - form[k], T(0.0f));
            product[k] = clamped[k] * T(record.product[k]);
            sum = vfma(clamped[k], T(record.inverse_weight[k]), sum);
            inverse_z_sum = inverse_z_sum + product[k];
        }
        inverse = vreciprocal(inverse_z_sum);
    }
    ETSPLAT_FN T depth() const { return sum * inverse; }
    ETSPLAT_FN T mean(T first, T second, T third) const {
        return vfma(product[0], first, vfma(product[1], second, product[2] * third)) * inverse;
    }
};

// Gradients of one pixel by what Interpolation computed from.
template <class T>
struct InterpolationGradient {
    T form[3];         // dL/d f_k
    T log_product[3];  // dL/d log(w_k z_k)
    T log_weight[3];   // dL/d log w_k, of the plane's depth alone

    // w: blend weight; grad_value[k]: sum over channels of cotangent times the colour of corner k, mean: their mean;
    // grad_depth: dL/d(1/z) of the plane's depth z, inverse_z = 1/z.
    ETSPLAT_FN void evaluate(const AttributeRecord& record, const Interpolation<T>& at, T w, const T* grad_value, T mean,
                             bool with_depth, T grad_depth, T plane_inverse_z) {
        const T share = w * at.inverse;
        const T grad_inverse_z_sum = with_depth ? grad_depth / at.sum : T(0.0f);
        for (int k = 0; k < 3; ++k) {
            T fall = share * (mean - grad_value[k]);  // -dL/d product[k]
            if (with_depth) fall = fall - grad_inverse_z_sum;
            T grad_form = fall * T(record.product[k]);
            if (with_depth) {
                const T of_sum = grad_inverse_z_sum * plane_inverse_z * T(record.inverse_weight[k]);
                grad_form = grad_form + of_sum;
                log_weight[k] = of_sum * at.clamped[k];
            }
            log_product[k] = fall * at.product[k];
            form[k] = vselect(at.positive[k], grad_form, T(0.0f));
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

// Gradients by the vertices of a triangle from its sums over pixels, sums[j] at SlotLayout's place j: in camera space (3, 3),
// and gx, gy (3 each) by their projections, which are part of it.
template <class T, class Sums>
ETSPLAT_FN void view_gradient(const PinholeCamera& camera, Distance distance, bool freeze_inradius,
                              const SlotLayout& layout, const Sums& sums, const T* view, const Triangle2D<T>& t,
                              T* grad_view, T* gx, T* gy) {
    T s[3], rx[3], ry[3], log_weight[3];
    for (int k = 0; k < 3; ++k) {
        gx[k] = gy[k] = log_weight[k] = T(0.0f);
        s[k] = sums[SlotLayout::kMoment + k];
        rx[k] = sums[SlotLayout::kMomentX + k];
        ry[k] = sums[SlotLayout::kMomentY + k];
    }
    for (int k = 0; k < 9; ++k) grad_view[k] = T(0.0f);
    if (layout.attributes())
        for (int k = 0; k < 3; ++k) {
            log_weight[k] = sums[layout.product() + k];
            grad_view[3 * k + 2] = log_weight[k] / view[3 * k + 2];
        }
    if (layout.depth == DistortionDepth::kPlane)
        for (int k = 0; k < 3; ++k) log_weight[k] = log_weight[k] + sums[layout.plane() + k];
    if (layout.depth == DistortionDepth::kCentroid)
        for (int k = 0; k < 3; ++k) grad_view[3 * k + 2] = grad_view[3 * k + 2] + sums[layout.centroid()] / T(3.0f);
    distance_backward(t, distance, freeze_inradius, s, rx, ry, log_weight, gx, gy);
    for (int k = 0; k < 3; ++k)
        project_backward(camera, view + 3 * k, t.x[k], t.y[k], gx[k], gy[k], grad_view + 3 * k);
}

}  // namespace etsplat
