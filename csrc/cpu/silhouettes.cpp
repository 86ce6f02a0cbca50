#include "silhouettes.h"

#include <algorithm>
#include <array>
#include <limits>

#include "parallel.h"

namespace etsplat {
namespace {

constexpr int64_t kBlock = 512;  // points that each view is asked about in turn: its map stays in the caches meanwhile
constexpr float kNoLimit = std::numeric_limits<float>::infinity();
constexpr float kOfDepth = 1e-3f;  // of a cost, a pixel of depth

// What a view says of a block of points: where they are in its map, how deep, and whether it judges.
struct Said {
    std::array<float, kBlock> x, y, z, depth;
    std::array<bool, kBlock> judged;
};

// Where a view shows points, and whether it judges them.
void locate(const SilhouetteView& view, const float* points, int64_t size, Said& said) {
    const float *m = view.viewmat, *K = view.K;
    const auto width = static_cast<float>(view.width), height = static_cast<float>(view.height);
    for (int64_t i = 0; i < size; ++i) {
        const float px = points[3 * i], py = points[3 * i + 1], pz = points[3 * i + 2];
        const float x = m[0] * px + m[1] * py + m[2] * pz + m[3];
        const float y = m[4] * px + m[5] * py + m[6] * pz + m[7];
        const float z = m[8] * px + m[9] * py + m[10] * pz + m[11];
        const bool front = z > 0.0f;
        const float inverse = 1.0f / (front ? z : 1.0f);
        const float column = (K[0] * x + K[1] * y + K[2] * z) * inverse, row = (K[3] * x + K[4] * y + K[5] * z) * inverse;
        const bool framed = (column > 0.0f) & (column < width) & (row > 0.0f) & (row < height);
        said.x[i] = std::min(std::max(column - 0.5f, 0.0f), width - 1.0f);
        said.y[i] = std::min(std::max(row - 0.5f, 0.0f), height - 1.0f);
        said.z[i] = z;
        said.judged[i] = front & (view.whole | framed);
    }
}

// Bilinear in its map, at whose border it ends.
void look_up(const SilhouetteView& view, int64_t size, Said& said) {
    for (int64_t i = 0; i < size; ++i) {
        const auto left = static_cast<int32_t>(said.x[i]), top = static_cast<int32_t>(said.y[i]);
        const float right = said.x[i] - static_cast<float>(left), below = said.y[i] - static_cast<float>(top);
        const int64_t across = left + 1 < view.width ? 1 : 0, down = top + 1 < view.height ? view.width : 0;
        const float* pixel = view.distance + static_cast<int64_t>(top) * view.width + left;
        const float upper = pixel[0] + right * (pixel[across] - pixel[0]);
        const float lower = pixel[down] + right * (pixel[down + across] - pixel[down]);
        said.depth[i] = upper + below * (lower - upper);
    }
}

// A number takes its place among the lowest `count` of a point, which are N apart.
void take_place(float number, int64_t count, int64_t N, float* lowest) {
    for (int64_t k = 0; k < count; ++k) {
        const float before = lowest[k * N];
        lowest[k * N] = std::min(before, number);
        number = std::max(before, number);
    }
}

// Asks every view about all points, block by block: take(number of the view, what it says, first point, how many).
template <class Take>
void ask_all(const std::vector<SilhouetteView>& views, const float* points, int64_t N, const Take& take) {
    parallel_for(N, kBlock, [&](int64_t begin, int64_t end) {
        Said said;
        for (int64_t start = begin; start < end; start += kBlock) {
            const int64_t size = std::min(kBlock, end - start);
            for (size_t number = 0; number < views.size(); ++number) {
                locate(views[number], points + 3 * start, size, said);
                look_up(views[number], size, said);
                take(number, said, start, size);
            }
        }
    });
}

}  // namespace

void lowest_depths(const std::vector<SilhouetteView>& views, const CarvingRule& rule, const float* points, const int64_t* own,
                   int64_t N, int64_t count, float* depth, float* judges) {
    std::fill(depth, depth + count * N, kNoLimit);
    std::fill(judges, judges + N, 0.0f);
    ask_all(views, points, N, [&](size_t number, const Said& said, int64_t start, int64_t size) {
        const float unit = rule.in_units ? 1.0f / views[number].K[0] : 0.0f;
        for (int64_t i = 0; i < size; ++i) {
            const int64_t n = start + i;
            if (!said.judged[i] || (own && own[n] == static_cast<int64_t>(number))) continue;
            const float pixels = said.depth[i] + rule.grown;
            take_place(rule.in_units ? pixels * (said.z[i] * unit) : pixels, count, N, depth + n);
            judges[n] += 1.0f;
        }
    });
}

void exclusion_costs(const std::vector<SilhouetteView>& views, const float* most, const float* points, int64_t N, float* cost) {
    std::fill(cost, cost + N, 0.0f);
    ask_all(views, points, N, [&](size_t number, const Said& said, int64_t start, int64_t size) {
        for (int64_t i = 0; i < size; ++i) {
            const float pixels = said.judged[i] ? said.depth[i] : kNoLimit;
            cost[start + i] += std::min(std::max(-pixels, 0.0f), most[number]) -
                               kOfDepth * std::min(std::max(pixels, 0.0f), 1.0f);
        }
    });
}

}  // namespace etsplat
