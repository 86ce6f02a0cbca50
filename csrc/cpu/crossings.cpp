#include "crossings.h"

#include <algorithm>
#include <limits>
#include <numeric>
#include <vector>

#include "bvh.h"
#include "parallel.h"

namespace etsplat {
namespace {

// Twice the signed area that a and b span, seen along x.
double span(Vec3 a, Vec3 b) { return a.y * b.z - a.z * b.y; }

// 1 where a ray from p along +x leaves through the triangle, -1 where it enters, 0 where it passes by.
int crossing(const Triangle& t, Vec3 p) {
    const Vec3 a = t.corner[0] - p, b = t.corner[1] - p, c = t.corner[2] - p;
    const double weights[3] = {span(b, c), span(c, a), span(a, b)};
    const bool positive = weights[0] > 0 && weights[1] > 0 && weights[2] > 0;
    const bool negative = weights[0] < 0 && weights[1] < 0 && weights[2] < 0;
    if (!positive && !negative) return 0;
    const double along = weights[0] * a.x + weights[1] * b.x + weights[2] * c.x;
    if (positive ? !(along > 0) : !(along < 0)) return 0;
    return positive ? 1 : -1;
}

}  // namespace

void count_crossings(const double* points, const int64_t* own, int64_t num_points, int64_t num_own,
                     const double* corners, int64_t num_faces, int64_t* counts) {
    std::vector<int64_t> faces(3 * num_faces);
    std::iota(faces.begin(), faces.end(), 0);
    const Bvh bvh(corners, faces.data(), num_faces);
    parallel_for(num_points, 64, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) {
            const Vec3 p = vertex(points, i);
            const int64_t* mine = own + num_own * i;
            int64_t count = 0;
            bvh.touching({p, {std::numeric_limits<double>::infinity(), p.y, p.z}}, [&](int32_t slot) {
                if (std::find(mine, mine + num_own, bvh.faces()[slot]) != mine + num_own) return;
                count += crossing(bvh.triangles()[slot], p);
            });
            counts[i] = count;
        }
    });
}

}  // namespace etsplat
