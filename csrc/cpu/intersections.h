// Which faces of a mesh cut through another face of it.
#pragma once

#include <cstdint>

namespace etsplat {

// Sets intersecting[f] to 1 if the interior (the open triangle) of face f has a point in common with the interior of
// another face, to 0 if not. Decided exactly (predicates.h). Faces that merely touch, or share a corner or an edge, do
// not count; coplanar faces that overlap do. Collinear faces have no interior and never count.
void mark_intersecting_faces(const double* vertices, const int64_t* faces, int64_t num_faces, uint8_t* intersecting);

}  // namespace etsplat
