// The mesh energies L_e, L_n, L_lap (paper, section 3.3) with their derivatives: first of one element, then of one vertex
// or face with everything around it, which is what an engine's loops call. Every edge and pair is visited from both its
// sides; its value counts half. Gradients are gathered: each vertex sums what concerns it, in a fixed order.
//
// Lengths and areas too small to have a direction give zero gradient: lengths up to kMinLength, faces whose doubled
// area is at most kMinShape times their longest edge squared (below that the float32 cross product is rounding noise).
#pragma once

#include "vector3.h"

namespace etsplat {

constexpr float kMinShape = 1e-6f;
constexpr float kMaxSquare = 3e38f;

// |a - b|^Power and its derivative by a.
template <int Power, class T>
ETSPLAT_FN Vector3<T> edge_energy(Vector3<T> a, Vector3<T> b, T& value) {
    static_assert(Power == 1 || Power == 2);
    const Vector3<T> d = a - b;
    if constexpr (Power == 1) {
        return direction(d, value);
    } else {
        value = dot(d, d);
        return T(2.0f) * d;
    }
}

template <class T>
struct FaceNormal {
    Vector3<T> unit;
    T inverse_norm;  // 1 / |(b - a) x (c - a)|; both 0 for a degenerate face
};

template <class T>
ETSPLAT_FN FaceNormal<T> face_normal(Vector3<T> a, Vector3<T> b, Vector3<T> c) {
    const Vector3<T> u = b - a, v = c - a, w = c - b;
    const Vector3<T> n = cross(u, v);
    const T square = dot(n, n), longest = vmax(dot(u, u), vmax(dot(v, v), dot(w, w)));
    const T floor = T(kMinShape) * longest;
    const bool usable = square > floor * floor && square < T(kMaxSquare);
    if (!usable) return {{T(0.0f), T(0.0f), T(0.0f)}, T(0.0f)};
    const T inverse = T(1.0f) / vsqrt(square);
    return {inverse * n, inverse};
}

// 1 - n0 . n1 = |n1 - n0|^2 / 2 (exact where the normals nearly agree), 0 if a face is degenerate; and its derivative
// by the cross product that n0 is the direction of.
template <class T>
ETSPLAT_FN Vector3<T> normal_energy(const FaceNormal<T>& f0, const FaceNormal<T>& f1, T& value) {
    const bool usable = f0.inverse_norm > T(0.0f) && f1.inverse_norm > T(0.0f);
    const Vector3<T> d = f1.unit - f0.unit;
    value = usable ? T(0.5f) * dot(d, d) : T(0.0f);
    const T scale = usable ? f0.inverse_norm : T(0.0f);
    return scale * (dot(d, f0.unit) * f0.unit - d);
}

// From the derivative g by (b - a) x (c - a) to those by b and c; the one by a is minus their sum.
template <class T>
ETSPLAT_FN void cross_backward(Vector3<T> a, Vector3<T> b, Vector3<T> c, Vector3<T> g, Vector3<T>& by_b,
                               Vector3<T>& by_c) {
    by_b = cross(c - a, g);
    by_c = cross(g, b - a);
}

// A mesh as etsplat.ops.mesh_energies.MeshConnectivity describes it.
struct MeshArrays {
    const Vector3<float>* vertices;
    const int* faces;             // (F, 3)
    const int* neighbor_offsets;  // (V + 1,)
    const int* neighbors;         // (2E,)
    const int* corner_offsets;    // (V + 1,)
    const int* corners;           // (3F,): 3 f + k
    const int* pair_offsets;      // (F + 1,)
    const int* paired_faces;      // (2P,)
    long long num_vertices, num_edges, num_pairs, num_faces;
};

ETSPLAT_FN float reciprocal(long long count) { return count > 0 ? 1.0f / static_cast<float>(count) : 0.0f; }

// Gradients by a vertex, and `spread`: its Laplacian's gradient by each of its neighbours, negated.
struct VertexGradients {
    Vector3<float> edge, laplacian, spread;
};

// Adds to the sums of lengths: of the edges at vertex i, half of each, and of its Laplacian.
template <int Power>
ETSPLAT_FN VertexGradients vertex_energies(const MeshArrays& mesh, long long i, double& edges, double& laplacian) {
    const float per_edge = reciprocal(mesh.num_edges), per_vertex = reciprocal(mesh.num_vertices);
    const Vector3<float> here = mesh.vertices[i];
    Vector3<float> gradient{0, 0, 0}, offset{0, 0, 0};  // offset: sum of here - neighbour
    const int begin = mesh.neighbor_offsets[i], end = mesh.neighbor_offsets[i + 1];
    for (int k = begin; k < end; ++k) {
        const Vector3<float> there = mesh.vertices[mesh.neighbors[k]];
        float value;
        gradient = gradient + edge_energy<Power>(here, there, value);
        edges += 0.5 * value;
        offset = offset + (here - there);
    }
    const float per_neighbor = reciprocal(end - begin);
    float length;
    const Vector3<float> unit = direction(per_neighbor * offset, length);
    laplacian += length;
    return {per_edge * gradient, per_vertex * unit, (per_vertex * per_neighbor) * unit};
}

ETSPLAT_FN FaceNormal<float> face_normal(const MeshArrays& mesh, long long f) {
    const int* k = mesh.faces + 3 * f;
    return face_normal(mesh.vertices[k[0]], mesh.vertices[k[1]], mesh.vertices[k[2]]);
}

// Adds half the disagreement of face f with each of its partners; corners[3] receives the gradient by its corners.
ETSPLAT_FN void pair_energies(const MeshArrays& mesh, const FaceNormal<float>* normals, long long f, double& sum,
                              Vector3<float>* corners) {
    Vector3<float> gradient{0, 0, 0};
    for (int k = mesh.pair_offsets[f]; k < mesh.pair_offsets[f + 1]; ++k) {
        float value;
        gradient = gradient + normal_energy(normals[f], normals[mesh.paired_faces[k]], value);
        sum += 0.5 * value;
    }
    const int* k = mesh.faces + 3 * f;
    cross_backward(mesh.vertices[k[0]], mesh.vertices[k[1]], mesh.vertices[k[2]],
                   reciprocal(mesh.num_pairs) * gradient, corners[1], corners[2]);
    corners[0] = Vector3<float>{0, 0, 0} - (corners[1] + corners[2]);
}

// Sum of `spread` over the neighbours of vertex i.
ETSPLAT_FN Vector3<float> gather_neighbors(const MeshArrays& mesh, const Vector3<float>* spread, long long i) {
    Vector3<float> sum{0, 0, 0};
    for (int k = mesh.neighbor_offsets[i]; k < mesh.neighbor_offsets[i + 1]; ++k) {
        sum = sum + spread[mesh.neighbors[k]];
    }
    return sum;
}

// Sum of the corners' gradients (3F,) over the corners at vertex i.
ETSPLAT_FN Vector3<float> gather_corners(const MeshArrays& mesh, const Vector3<float>* corner_gradients, long long i) {
    Vector3<float> sum{0, 0, 0};
    for (int k = mesh.corner_offsets[i]; k < mesh.corner_offsets[i + 1]; ++k) {
        sum = sum + corner_gradients[mesh.corners[k]];
    }
    return sum;
}

}  // namespace etsplat
