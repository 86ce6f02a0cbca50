// How it is scheduled. Four parallel passes, each writing only its own elements: (1) faces: unit normals; (2) vertices:
// the edge energy of their edges, the direction of their Laplacian; (3) faces: the normal energy with their neighbours,
// pulled back to their corners; (4) vertices: gather of the Laplacian from neighbours, of the normals from corners.
// Every edge and pair is visited from both sides; its value counts half. Values are summed in double over fixed pieces.
// About 90 bytes of buffers a face; no atomics, so that results do not depend on the threads.
#include <algorithm>
#include <vector>

#include "bindings.h"
#include "math/mesh_energies.h"
#include "parallel.h"

namespace etsplat {
namespace {

using Vector = Vector3<float>;

constexpr int64_t kPiece = 1024;  // elements whose values are summed together

struct Mesh {
    const Vector* vertices;
    const int32_t* faces;             // (F, 3)
    const int32_t* neighbor_offsets;  // (V + 1,)
    const int32_t* neighbors;         // (2E,)
    const int32_t* corner_offsets;    // (V + 1,)
    const int32_t* corners;           // (3F,): 3 f + k
    const int32_t* pair_offsets;      // (F + 1,)
    const int32_t* paired_faces;      // (2P,)
    int64_t num_vertices, num_edges, num_pairs, num_faces;
};

struct Gradients {
    Vector *edge, *normal, *laplacian;  // (V,) each
};

float reciprocal(int64_t count) { return count > 0 ? 1.0f / static_cast<float>(count) : 0.0f; }

// Sum of body(i) over [0, n), in double, piece after piece.
template <class Body>
void sum_in_pieces(int64_t n, std::vector<double>& first, std::vector<double>& second, const Body& body) {
    const int64_t pieces = (n + kPiece - 1) / kPiece;
    first.assign(pieces, 0.0);
    second.assign(pieces, 0.0);
    parallel_for(pieces, 4, [&](int64_t begin, int64_t end) {
        for (int64_t piece = begin; piece < end; ++piece) {
            double a = 0.0, b = 0.0;
            for (int64_t i = piece * kPiece; i < std::min(n, (piece + 1) * kPiece); ++i) body(i, a, b);
            first[piece] = a;
            second[piece] = b;
        }
    });
}

double total(const std::vector<double>& sums) {
    double result = 0.0;
    for (const double sum : sums) result += sum;
    return result;
}

struct Buffers {
    std::vector<FaceNormal<float>> normals;  // (F,)
    std::vector<Vector> directions;          // (V,): Laplacian direction / number of neighbours
    std::vector<Vector> corner_gradients;    // (3F,)
    std::vector<double> first, second;
};

template <int Power>
void edges_and_laplacian(const Mesh& mesh, Buffers& buffers, const Gradients& gradients, double values[3]) {
    const float per_edge = reciprocal(mesh.num_edges), per_vertex = reciprocal(mesh.num_vertices);
    sum_in_pieces(mesh.num_vertices, buffers.first, buffers.second, [&](int64_t i, double& edges, double& laplacian) {
        const Vector here = mesh.vertices[i];
        Vector gradient{0, 0, 0}, offset{0, 0, 0};  // offset: sum of here - neighbour
        const int32_t begin = mesh.neighbor_offsets[i], end = mesh.neighbor_offsets[i + 1];
        for (int32_t k = begin; k < end; ++k) {
            const Vector there = mesh.vertices[mesh.neighbors[k]];
            float value;
            gradient = gradient + edge_energy<Power>(here, there, value);
            edges += 0.5 * value;
            offset = offset + (here - there);
        }
        const float per_neighbor = reciprocal(end - begin);
        float length;
        const Vector unit = direction(per_neighbor * offset, length);
        laplacian += length;
        gradients.edge[i] = per_edge * gradient;
        gradients.laplacian[i] = per_vertex * unit;
        buffers.directions[i] = (per_vertex * per_neighbor) * unit;
    });
    values[0] = total(buffers.first) * per_edge;
    values[2] = total(buffers.second) * per_vertex;
}

void normals(const Mesh& mesh, Buffers& buffers, double values[3]) {
    parallel_for(mesh.num_faces, 4 * kPiece, [&](int64_t begin, int64_t end) {
        for (int64_t f = begin; f < end; ++f) {
            const int32_t* k = mesh.faces + 3 * f;
            buffers.normals[f] = face_normal(mesh.vertices[k[0]], mesh.vertices[k[1]], mesh.vertices[k[2]]);
        }
    });
    const float per_pair = reciprocal(mesh.num_pairs);
    sum_in_pieces(mesh.num_faces, buffers.first, buffers.second, [&](int64_t f, double& sum, double&) {
        Vector gradient{0, 0, 0};
        for (int32_t k = mesh.pair_offsets[f]; k < mesh.pair_offsets[f + 1]; ++k) {
            float value;
            gradient = gradient + normal_energy(buffers.normals[f], buffers.normals[mesh.paired_faces[k]], value);
            sum += 0.5 * value;
        }
        const int32_t* k = mesh.faces + 3 * f;
        Vector* out = buffers.corner_gradients.data() + 3 * f;
        cross_backward(mesh.vertices[k[0]], mesh.vertices[k[1]], mesh.vertices[k[2]], per_pair * gradient, out[1],
                       out[2]);
        out[0] = Vector{0, 0, 0} - (out[1] + out[2]);
    });
    values[1] = total(buffers.first) * per_pair;
}

void gather(const Mesh& mesh, const Buffers& buffers, const Gradients& gradients) {
    parallel_for(mesh.num_vertices, 2 * kPiece, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) {
            Vector laplacian{0, 0, 0}, normal{0, 0, 0};
            for (int32_t k = mesh.neighbor_offsets[i]; k < mesh.neighbor_offsets[i + 1]; ++k) {
                laplacian = laplacian + buffers.directions[mesh.neighbors[k]];
            }
            for (int32_t k = mesh.corner_offsets[i]; k < mesh.corner_offsets[i + 1]; ++k) {
                normal = normal + buffers.corner_gradients[mesh.corners[k]];
            }
            gradients.laplacian[i] = gradients.laplacian[i] - laplacian;
            gradients.normal[i] = normal;
        }
    });
}

void mesh_energies(const Mesh& mesh, int edge_power, const Gradients& gradients, double values[3]) {
    Buffers buffers;
    buffers.normals.resize(mesh.num_faces);
    buffers.directions.resize(mesh.num_vertices);
    buffers.corner_gradients.resize(3 * mesh.num_faces);
    const auto pass = edge_power == 1 ? edges_and_laplacian<1> : edges_and_laplacian<2>;
    pass(mesh, buffers, gradients, values);
    normals(mesh, buffers, values);
    gather(mesh, buffers, gradients);
}

void combine(const float* gradients, const std::vector<float>& weights, int64_t size, float* combined) {
    const float a = weights.at(0), b = weights.at(1), c = weights.at(2);
    parallel_for(size, 16 * kPiece, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) {
            combined[i] = a * gradients[i] + b * gradients[size + i] + c * gradients[2 * size + i];
        }
    });
}

}  // namespace

void bind_mesh_energies(nb::module_& m) {
    // Addresses: vertices (V, 3) float32; the int32 arrays of etsplat.ops.mesh_energies.MeshConnectivity; gradients
    // (3, V, 3) float32: of the edge, normal and Laplacian energy. Returns the three values.
    m.def(
        "mesh_energies",
        [](Address vertices, Address faces, Address neighbor_offsets, Address neighbors, Address corner_offsets,
           Address corners, Address pair_offsets, Address paired_faces, int64_t num_vertices, int64_t num_edges,
           int64_t num_pairs, int64_t num_faces, int edge_power, Address gradients) {
            const Mesh mesh{pointer<const Vector>(vertices),        pointer<const int32_t>(faces),
                            pointer<const int32_t>(neighbor_offsets), pointer<const int32_t>(neighbors),
                            pointer<const int32_t>(corner_offsets), pointer<const int32_t>(corners),
                            pointer<const int32_t>(pair_offsets),   pointer<const int32_t>(paired_faces),
                            num_vertices, num_edges, num_pairs, num_faces};
            Vector* out = pointer<Vector>(gradients);
            std::vector<double> values(3);
            mesh_energies(mesh, edge_power, {out, out + num_vertices, out + 2 * num_vertices}, values.data());
            return values;
        },
        NoGil());
    // combined (size,) = weights . gradients (3, size), all float32.
    m.def(
        "combine_mesh_gradients",
        [](Address gradients, const std::vector<float>& weights, int64_t size, Address combined) {
            combine(pointer<const float>(gradients), weights, size, pointer<float>(combined));
        },
        NoGil());
}

}  // namespace etsplat
