// Real spherical harmonics up to degree 3 as 3D Gaussian splatting orders and signs them: band l holds m = -l..l, with
// the Condon-Shortley sign, as polynomials of a unit direction.
#pragma once

#include "vector3.h"

namespace etsplat {

constexpr int kMaxShDegree = 3;
constexpr int kMaxShBases = (kMaxShDegree + 1) * (kMaxShDegree + 1);

constexpr float kSh0 = 0.28209479177387814f;       // sqrt(1 / (4 pi))
constexpr float kSh1 = 0.4886025119029199f;        // sqrt(3 / (4 pi))
constexpr float kSh2Mixed = 1.0925484305920792f;   // sqrt(15 / (4 pi))
constexpr float kSh2Zonal = 0.31539156525252005f;  // sqrt(5 / (16 pi))
constexpr float kSh2Square = 0.5462742152960396f;  // sqrt(15 / (16 pi))
constexpr float kSh3Cubic = 0.5900435899266435f;   // sqrt(35 / (32 pi))
constexpr float kSh3Mixed = 2.890611442640554f;    // sqrt(105 / (4 pi))
constexpr float kSh3Tilted = 0.4570457994644658f;  // sqrt(21 / (32 pi))
constexpr float kSh3Zonal = 0.3731763325901154f;   // sqrt(7 / (16 pi))
constexpr float kSh3Square = 1.445305721320277f;   // sqrt(105 / (16 pi))

// basis[(degree + 1)^2] at the unit direction d.
template <class T>
ETSPLAT_FN void sh_basis(int degree, Vector3<T> d, T* basis) {
    const T x = d.x, y = d.y, z = d.z;
    basis[0] = T(kSh0);
    if (degree < 1) return;
    basis[1] = T(-kSh1) * y;
    basis[2] = T(kSh1) * z;
    basis[3] = T(-kSh1) * x;
    if (degree < 2) return;
    const T xx = x * x, yy = y * y, zz = z * z;
    basis[4] = T(kSh2Mixed) * x * y;
    basis[5] = T(-kSh2Mixed) * y * z;
    basis[6] = T(kSh2Zonal) * (zz + zz - xx - yy);
    basis[7] = T(-kSh2Mixed) * x * z;
    basis[8] = T(kSh2Square) * (xx - yy);
    if (degree < 3) return;
    const T tilted = T(4.0f) * zz - xx - yy;
    basis[9] = T(-kSh3Cubic) * y * (T(3.0f) * xx - yy);
    basis[10] = T(kSh3Mixed) * x * y * z;
    basis[11] = T(-kSh3Tilted) * y * tilted;
    basis[12] = T(kSh3Zonal) * z * (zz + zz - T(3.0f) * (xx + yy));
    basis[13] = T(-kSh3Tilted) * x * tilted;
    basis[14] = T(kSh3Square) * z * (xx - yy);
    basis[15] = T(-kSh3Cubic) * x * (xx - T(3.0f) * yy);
}

// Sum of g[k] times the derivative of basis k, as the polynomial it is, by d.
template <class T>
ETSPLAT_FN Vector3<T> sh_basis_backward(int degree, Vector3<T> d, const T* g) {
    const T x = d.x, y = d.y, z = d.z;
    Vector3<T> sum{T(0.0f), T(0.0f), T(0.0f)};
    if (degree < 1) return sum;
    sum = {T(-kSh1) * g[3], T(-kSh1) * g[1], T(kSh1) * g[2]};
    if (degree < 2) return sum;
    const T g4 = T(kSh2Mixed) * g[4], g5 = T(-kSh2Mixed) * g[5], g6 = T(2.0f * kSh2Zonal) * g[6];
    const T g7 = T(-kSh2Mixed) * g[7], g8 = T(2.0f * kSh2Square) * g[8];
    sum = sum + Vector3<T>{g4 * y - g6 * x + g7 * z + g8 * x, g4 * x + g5 * z - g6 * y - g8 * y,
                           g5 * y + T(2.0f) * g6 * z + g7 * x};
    if (degree < 3) return sum;
    const T xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
    const T g9 = T(-3.0f * kSh3Cubic) * g[9], g10 = T(kSh3Mixed) * g[10], g11 = T(-kSh3Tilted) * g[11];
    const T g12 = T(3.0f * kSh3Zonal) * g[12], g13 = T(-kSh3Tilted) * g[13], g14 = T(kSh3Square) * g[14];
    const T g15 = T(-3.0f * kSh3Cubic) * g[15];
    const T two = T(2.0f), three = T(3.0f), four = T(4.0f), eight = T(8.0f);
    return sum + Vector3<T>{g9 * two * xy + g10 * yz - g11 * two * xy - g12 * two * xz +
                                g13 * (four * zz - three * xx - yy) + g14 * two * xz + g15 * (xx - yy),
                            g9 * (xx - yy) + g10 * xz + g11 * (four * zz - xx - three * yy) - g12 * two * yz -
                                g13 * two * xy - g14 * two * yz - g15 * two * xy,
                            g10 * xy + g11 * eight * yz + g12 * (two * zz - xx - yy) + g13 * eight * xz +
                                g14 * (xx - yy)};
}

// Normalises. Returns the degree to use: a direction without length shows the constant band only.
ETSPLAT_FN int sh_direction(int degree, Vector3<float> raw, Vector3<float>& unit, float& length) {
    unit = direction(raw, length);
    return length > kMinLength ? degree : 0;
}

// From the gradient g by the polynomials' argument to that by the direction as it was given.
ETSPLAT_FN Vector3<float> sh_direction_backward(int degree, Vector3<float> unit, float length, Vector3<float> g) {
    const float inverse = degree > 0 ? 1.0f / length : 0.0f;
    return inverse * (g - dot(g, unit) * unit);
}

// Colour of a triangle seen along `toward`, of any length; its coefficients are split: the constant band and the rest.
ETSPLAT_FN void soup_color(int degree, Vector3<float> toward, const float* dc, const float* rest, float* color) {
    float basis[kMaxShBases] = {}, length, sum[3];
    const Vector3<float> unit = direction(toward, length);
    sh_basis(degree, unit, basis);
    for (int c = 0; c < 3; ++c) sum[c] = 0.5f + kSh0 * dc[c];
    if (length > kMinLength) {
        for (int k = 1; k < (degree + 1) * (degree + 1); ++k)
            for (int c = 0; c < 3; ++c) sum[c] += basis[k] * rest[3 * (k - 1) + c];
    }
    for (int c = 0; c < 3; ++c) color[c] = vmax(sum[c], 0.0f);
}

// From the gradient by the colour before its clamp: adds to those by dc and rest, returns that by `toward`.
ETSPLAT_FN Vector3<float> soup_color_backward(int degree, Vector3<float> toward, const float* rest,
                                              const float* cotangent, float* grad_dc, float* grad_rest) {
    float basis[kMaxShBases] = {}, along[kMaxShBases] = {}, length;
    for (int c = 0; c < 3; ++c) grad_dc[c] += kSh0 * cotangent[c];
    const Vector3<float> unit = direction(toward, length);
    if (degree == 0 || length <= kMinLength) return {0.0f, 0.0f, 0.0f};
    sh_basis(degree, unit, basis);
    for (int k = 1; k < (degree + 1) * (degree + 1); ++k) {
        along[k] = 0.0f;
        for (int c = 0; c < 3; ++c) {
            grad_rest[3 * (k - 1) + c] += cotangent[c] * basis[k];
            along[k] += cotangent[c] * rest[3 * (k - 1) + c];
        }
    }
    const Vector3<float> g = sh_basis_backward(degree, unit, along);
    return (1.0f / length) * (g - dot(g, unit) * unit);  // through the normalisation
}

}  // namespace etsplat
