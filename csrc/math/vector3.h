// A vector of three numbers.
#pragma once

#include "portable.h"

namespace etsplat {

template <class T>
struct Vector3 {
    T x, y, z;
};

template <class T>
ETSPLAT_FN Vector3<T> operator+(Vector3<T> a, Vector3<T> b) {
    return {a.x + b.x, a.y + b.y, a.z + b.z};
}

template <class T>
ETSPLAT_FN Vector3<T> operator-(Vector3<T> a, Vector3<T> b) {
    return {a.x - b.x, a.y - b.y, a.z - b.z};
}

template <class T>
ETSPLAT_FN Vector3<T> operator*(T s, Vector3<T> a) {
    return {s * a.x, s * a.y, s * a.z};
}

template <class T>
ETSPLAT_FN T dot(Vector3<T> a, Vector3<T> b) {
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

template <class T>
ETSPLAT_FN Vector3<T> cross(Vector3<T> a, Vector3<T> b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

constexpr float kMinLength = 1e-12f;  // up to here a vector has no direction

// d / |d|, or 0; `length` receives |d|.
template <class T>
ETSPLAT_FN Vector3<T> direction(Vector3<T> d, T& length) {
    length = vsqrt(dot(d, d));
    const T inverse = vselect(length > T(kMinLength), T(1.0f) / vmax(length, T(kMinLength)), T(0.0f));
    return inverse * d;
}

}  // namespace etsplat
