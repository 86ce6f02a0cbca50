// How often a ray passes through a mesh.
#pragma once

#include <cstdint>

namespace etsplat {

// counts[i] becomes how many faces the ray from point i along +x leaves through less those it enters through: as seen
// against it their corners go round clockwise, or not. The own[i] faces of a point do not count. Coordinates are finite.
//   points: rows of 3; own: rows of num_own indices, negative ones for none; vertices and faces: rows of 3.
void count_crossings(const double* points, const int64_t* own, int64_t num_points, int64_t num_own,
                     const double* vertices, const int64_t* faces, int64_t num_faces, int64_t* counts);

}  // namespace etsplat
