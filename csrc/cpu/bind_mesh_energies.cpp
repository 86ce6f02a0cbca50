// How it is scheduled. Four parallel passes, each writing only its own elements: (1) faces: unit normals; (2) vertices:
// the edge energy of their edges, the direction of their Laplacian; (3) faces: the normal energy with their neighbours,
// pulled back to their corners; (4) vertices: gather of the Laplacian from neighbours, of the normals from corners.
// Values are summed in double over fixed pieces. About 90 bytes of buffers a face; no atomics, so that results do not
// depend on the threads.
#include <algorithm>
#include <vector>

#include "bindings.h"
#include "math/mesh_energies.h"
#include "parallel.h"

namespace etsplat {
namespace {

using Vector = Vector3<float>;

constexpr int64_t kPiece = 1024;  // elements whose values are summed together

struct Gradients {
    Vector *edge, *normal, *laplacian;  // (V,) each
};

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
    std::vector<Vector> spread;              // (V,)
    std::vector<Vector> corner_gradients;    // (3F,)
    std::vector<double> first, second;
};

template <int Power>
void edges_and_laplacian(const MeshArrays& mesh, Buffers& buffers, const Gradients& gradients, double values[3]) {
    sum_in_pieces(mesh.num_vertices, buffers.first, buffers.second, [&](int64_t i, double& edges, double& laplacian) {
        const VertexGradients g = vertex_energies<Power>(mesh, i, edges, laplacian);
        gradients.edge[i] = g.edge;
        gradients.laplacian[i] = g.laplacian;
        buffers.spread[i] = g.spread;
    });
    values[0] = total(buffers.first) * reciprocal(mesh.num_edges);
    values[2] = total(buffers.second) * reciprocal(mesh.num_vertices);
}

void normals(const MeshArrays& mesh, Buffers& buffers, double values[3]) {
    parallel_for(mesh.num_faces, 4 * kPiece, [&](int64_t begin, int64_t end) {
        for (int64_t f = begin; f < end; ++f) buffers.normals[f] = face_normal(mesh, f);
    });
    sum_in_pieces(mesh.num_faces, buffers.first, buffers.second, [&](int64_t f, double& sum, double&) {
        pair_energies(mesh, buffers.normals.data(), f, sum, buffers.corner_gradients.data() + 3 * f);
    });
    values[1] = total(buffers.first) * reciprocal(mesh.num_pairs);
}

void gather(const MeshArrays& mesh, const Buffers& buffers, const Gradients& gradients) {
    parallel_for(mesh.num_vertices, 2 * kPiece, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) {
            gradients.laplacian[i] = gradients.laplacian[i] - gather_neighbors(mesh, buffers.spread.data(), i);
            gradients.normal[i] = gather_corners(mesh, buffers.corner_gradients.data(), i);
        }
    });
}

void mesh_energies(const MeshArrays& mesh, int edge_power, const Gradients& gradients, double values[3]) {
    Buffers buffers;
    buffers.normals.resize(mesh.num_faces);
    buffers.spread.resize(mesh.num_vertices);
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
    // vertices (V, 3); the arrays of etsplat.core.connectivity.MeshConnectivity; gradients (3, V, 3): of the edge, normal
    // and Laplacian energy. Returns the three values.
    def_function(
        m, "mesh_energies",
        [](Array<const float, 2> vertices, Array<const int32_t, 2> faces, Array<const int32_t, 1> neighbor_offsets,
           Array<const int32_t, 1> neighbor_indices, Array<const int32_t, 1> corner_offsets,
           Array<const int32_t, 1> corners, Array<const int32_t, 1> pair_offsets, Array<const int32_t, 1> paired_faces,
           int edge_power, Array<float, 3> gradients) {
            const MeshArrays mesh{reinterpret_cast<const Vector*>(vertices.data()),
                                  faces.data(),
                                  neighbor_offsets.data(),
                                  neighbor_indices.data(),
                                  corner_offsets.data(),
                                  corners.data(),
                                  pair_offsets.data(),
                                  paired_faces.data(),
                                  neighbor_offsets.count() - 1,
                                  neighbor_indices.count() / 2,
                                  paired_faces.count() / 2,
                                  faces.size(0)};
            const auto by = [&](int64_t energy) { return reinterpret_cast<Vector*>(gradients.row(energy)); };
            std::vector<double> values(3);
            mesh_energies(mesh, edge_power, {by(0), by(1), by(2)}, values.data());
            return values;
        },
        "vertices", "faces", "neighbor_offsets", "neighbor_indices", "corner_offsets", "corners", "pair_offsets",
        "paired_faces", "edge_power", "gradients");
    // combined (V, 3) = weights . gradients (3, V, 3).
    def_function(
        m, "combine_mesh_gradients",
        [](Array<const float, 3> gradients, const std::vector<float>& weights, Array<float, 2> combined) {
            combine(gradients.data(), weights, combined.count(), combined.data());
        },
        "gradients", "weights", "combined");
}

}  // namespace etsplat
