// Edges of a mesh that are better turned to the other diagonal of their two faces.
#pragma once

#include <cstdint>

namespace etsplat {

struct EdgesOfMesh {
    int64_t* edges;       // (E, 2) vertices
    int64_t* edge_faces;  // (E, 2) faces; -1 and -1 for an edge that stays
    int64_t* face_edges;  // (F, 3) edge from corner k to corner (k + 1) % 3
    int64_t* faces;       // (F, 3) vertices
    int64_t* valences;    // (V,) how many edges each vertex has
};

// Turns edges whose two opposite angles make more than half a circle (Delaunay's criterion) to the other diagonal of
// their faces, where the cosines between the two faces before, the two after and the one and the others are
// `least_cosine` at least, until none is left or `rounds` are over. All arrays are kept up. A flip makes no edge that is
// there already and leaves each vertex three edges, so a manifold stays one. Serial, in the order of the edges. Returns
// how many flips there were.
int64_t flip_edges(const double* vertices, EdgesOfMesh mesh, int64_t num_edges, double least_cosine, int rounds);

}  // namespace etsplat
