// Faces are gone through once, with the points in order of y: those beside a face are one run of them. There are mostly few
// points, so that a hierarchy of the faces would take longer to build.
#include "crossings.h"

#include <algorithm>
#include <atomic>
#include <numeric>
#include <vector>

#include "parallel.h"
#include "vec3.h"

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
                     const double* vertices, const int64_t* faces, int64_t num_faces, int64_t* counts) {
    std::vector<int64_t> order(num_points);
    std::iota(order.begin(), order.end(), 0);
    std::sort(order.begin(), order.end(), [points](int64_t a, int64_t b) { return points[3 * a + 1] < points[3 * b + 1]; });
    std::vector<double> down(num_points);
    for (int64_t i = 0; i < num_points; ++i) down[i] = points[3 * order[i] + 1];
    std::vector<std::atomic<int64_t>> sums(num_points);
    parallel_for(num_faces, 4096, [&](int64_t begin, int64_t end) {
        for (int64_t face = begin; face < end; ++face) {
            const Triangle t = triangle(vertices, faces + 3 * face);
            const Vec3 low = min(min(t.corner[0], t.corner[1]), t.corner[2]);
            const Vec3 high = max(max(t.corner[0], t.corner[1]), t.corner[2]);
            auto at = std::lower_bound(down.begin(), down.end(), low.y);
            for (; at != down.end() && *at <= high.y; ++at) {
                const int64_t i = order[at - down.begin()];
                const Vec3 p = vertex(points, i);
                if (p.x > high.x || p.z < low.z || p.z > high.z) continue;
                const int64_t* mine = own + num_own * i;
                if (std::find(mine, mine + num_own, face) != mine + num_own) continue;
                if (const int passed = crossing(t, p)) sums[i].fetch_add(passed, std::memory_order_relaxed);
            }
        }
    });
    for (int64_t i = 0; i < num_points; ++i) counts[i] = sums[i].load(std::memory_order_relaxed);
}

}  // namespace etsplat
