// Which faces of a mesh cut through another face of it, or might.
#pragma once

#include <cstdint>
#include <vector>

#include "bvh.h"

namespace etsplat {

// Sets intersecting[f] to 1 if the interior (the open triangle) of face f has a point in common with the interior of
// another face, to 0 if not. Decided exactly (predicates.h). Faces that merely touch, or share a corner or an edge, do
// not count; coplanar faces that overlap do. Collinear faces have no interior and never count. Two faces for which
// `again` is 0 are not compared.
void mark_intersecting_faces(const Bvh& bvh, const uint8_t* again, uint8_t* intersecting);

// All pairs of faces whose boxes have a point in common, one behind the other; each pair once, in an order that depends on
// the mesh alone.
std::vector<int64_t> overlapping_boxes(const Bvh& bvh);

}  // namespace etsplat
