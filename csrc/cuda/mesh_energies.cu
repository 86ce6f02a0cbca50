// Mesh energies with their gradients (csrc/math/mesh_energies.h), in three launches: (1) unit normals of the faces, and the
// edges and Laplacian of the vertices, in blocks of their own; (2) pairs of faces, pulled back to their corners; (3) what
// each vertex gathers from its neighbours and corners, while one more block adds up the sums that (1) and (2) left.
//
// One thread to an element, gathers instead of atomics: the same bits in every run. About 430 bytes a vertex with its two
// faces are read and written, most of them through the L2 cache: launches, not bytes, bound it below a million faces.
#include "cuda/block_sum.h"
#include "math/mesh_energies.h"

using namespace etsplat;

using Vector = Vector3<float>;

constexpr int kThreads = kBlock;

__device__ long long block_count(long long elements) { return (elements + kThreads - 1) / kThreads; }

// vertex_sums (2 per block of vertices): the edges' lengths, the Laplacians'. gradients (3, V): edge, normal, Laplacian.
extern "C" __global__ void mesh_elements(MeshArrays mesh, int edge_power, FaceNormal<float>* normals, Vector* spread,
                                         Vector* gradients, double* vertex_sums) {
    __shared__ double scratch[kThreads / kWarp];
    const long long face_blocks = block_count(mesh.num_faces);
    if (blockIdx.x < face_blocks) {
        const long long f = static_cast<long long>(blockIdx.x) * kThreads + threadIdx.x;
        if (f < mesh.num_faces) normals[f] = face_normal(mesh, f);
        return;
    }
    const long long block = blockIdx.x - face_blocks, i = block * kThreads + threadIdx.x;
    double edges = 0.0, laplacian = 0.0;
    if (i < mesh.num_vertices) {
        const VertexGradients g = edge_power == 1 ? vertex_energies<1>(mesh, i, edges, laplacian)
                                                  : vertex_energies<2>(mesh, i, edges, laplacian);
        gradients[i] = g.edge;
        gradients[2 * mesh.num_vertices + i] = g.laplacian;
        spread[i] = g.spread;
    }
    edges = block_sum<kThreads>(edges, scratch);
    laplacian = block_sum<kThreads>(laplacian, scratch);
    if (threadIdx.x == 0) {
        vertex_sums[2 * block] = edges;
        vertex_sums[2 * block + 1] = laplacian;
    }
}

extern "C" __global__ void mesh_pairs(MeshArrays mesh, const FaceNormal<float>* normals, Vector* corner_gradients,
                                      double* face_sums) {
    __shared__ double scratch[kThreads / kWarp];
    const long long f = static_cast<long long>(blockIdx.x) * kThreads + threadIdx.x;
    double sum = 0.0;
    if (f < mesh.num_faces) pair_energies(mesh, normals, f, sum, corner_gradients + 3 * f);
    sum = block_sum<kThreads>(sum, scratch);
    if (threadIdx.x == 0) face_sums[blockIdx.x] = sum;
}

// The last block of the grid writes the three energies, the others their vertices.
extern "C" __global__ void mesh_gather(MeshArrays mesh, const Vector* spread, const Vector* corner_gradients,
                                       Vector* gradients, const double* vertex_sums, const double* face_sums,
                                       float* edge_energy, float* normal_energy, float* laplacian_energy) {
    __shared__ double scratch[kThreads / kWarp];
    if (blockIdx.x == gridDim.x - 1) {
        const long long vertex_blocks = block_count(mesh.num_vertices), face_blocks = block_count(mesh.num_faces);
        const double edges = sum_of_array<kThreads>(vertex_sums, vertex_blocks, 2, scratch);
        const double laplacian = sum_of_array<kThreads>(vertex_sums + 1, vertex_blocks, 2, scratch);
        const double normal = sum_of_array<kThreads>(face_sums, face_blocks, 1, scratch);
        if (threadIdx.x == 0) {
            *edge_energy = static_cast<float>(edges * reciprocal(mesh.num_edges));
            *normal_energy = static_cast<float>(normal * reciprocal(mesh.num_pairs));
            *laplacian_energy = static_cast<float>(laplacian * reciprocal(mesh.num_vertices));
        }
        return;
    }
    const long long i = static_cast<long long>(blockIdx.x) * kThreads + threadIdx.x;
    if (i >= mesh.num_vertices) return;
    Vector* laplacian = gradients + 2 * mesh.num_vertices + i;
    *laplacian = *laplacian - gather_neighbors(mesh, spread, i);
    gradients[mesh.num_vertices + i] = gather_corners(mesh, corner_gradients, i);
}

// combined (size,) = weights . gradients (3, size); the weights are three scalars in device memory.
extern "C" __global__ void mesh_combine(const float* gradients, const float* edge, const float* normal,
                                        const float* laplacian, long long size, float* combined) {
    const long long i = static_cast<long long>(blockIdx.x) * kThreads + threadIdx.x;
    if (i >= size) return;
    combined[i] = *edge * gradients[i] + *normal * gradients[size + i] + *laplacian * gradients[2 * size + i];
}
