// Three doubles, for geometry that wants more than a splat's precision.
#pragma once

#include <algorithm>
#include <cstdint>

namespace etsplat {

struct Vec3 {
    double x, y, z;
};

inline Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec3 operator*(double s, Vec3 a) { return {s * a.x, s * a.y, s * a.z}; }
inline double dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec3 cross(Vec3 a, Vec3 b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
inline Vec3 min(Vec3 a, Vec3 b) { return {std::min(a.x, b.x), std::min(a.y, b.y), std::min(a.z, b.z)}; }
inline Vec3 max(Vec3 a, Vec3 b) { return {std::max(a.x, b.x), std::max(a.y, b.y), std::max(a.z, b.z)}; }

struct Triangle {
    Vec3 corner[3];
};

inline Vec3 vertex(const double* vertices, int64_t index) {
    return {vertices[3 * index], vertices[3 * index + 1], vertices[3 * index + 2]};
}

inline Triangle triangle(const double* vertices, const int64_t* face) {
    return {{vertex(vertices, face[0]), vertex(vertices, face[1]), vertex(vertices, face[2])}};
}

}  // namespace etsplat
