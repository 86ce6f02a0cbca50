// The search for silhouettes between pixels: step (1) and (3) of antialias.cpp.
#include <algorithm>
#include <cmath>

#include "antialias.h"
#include "math/antialias.h"
#include "parallel.h"
#include "scratch.h"

namespace etsplat {
namespace {

constexpr int32_t kRows = 16;  // of a band

struct Point {
    double at[2];  // x, y
    bool drawn;
};

void project_vertices(const ShadeInput& in, Scratch<Point>& points) {
    const PinholeCamera camera = pinhole(in.camera);
    parallel_for(in.mesh.num_vertices, 4096, [&](int64_t begin, int64_t end) {
        for (int64_t v = begin; v < end; ++v) {
            const float* p = in.mesh.vertices + 3 * v;
            const double world[3] = {p[0], p[1], p[2]};
            double view[3];
            to_camera(camera, world, view);
            Point& q = points[v];
            project(camera, view, q.at[0], q.at[1]);
            q.drawn = view[2] > static_cast<double>(in.camera.near_plane) && std::isfinite(q.at[0]) &&
                      std::isfinite(q.at[1]);
        }
    });
}

// Bit k of a face: its edge from corner k to k + 1 is a silhouette, that is, no face across it lies on the other side.
std::vector<uint8_t> find_silhouettes(const AntialiasInput& in, const Scratch<Point>& points) {
    const OpaqueMesh& mesh = in.shading.mesh;
    std::vector<uint8_t> bits(mesh.num_faces);
    parallel_for(mesh.num_faces, 2048, [&](int64_t begin, int64_t end) {
        for (int64_t f = begin; f < end; ++f) {
            const int32_t* own = mesh.faces + 3 * f;
            int found = 7;
            for (int32_t i = in.pair_offsets[f]; i < in.pair_offsets[f + 1]; ++i) {
                const int32_t* other = mesh.faces + 3 * static_cast<int64_t>(in.paired_faces[i]);
                if (!points[other[0]].drawn || !points[other[1]].drawn || !points[other[2]].drawn) continue;
                for (int k = 0; k < 3; ++k) {
                    const int32_t a = own[k], b = own[(k + 1) % 3];
                    for (int j = 0; j < 3; ++j) {
                        const int32_t p = other[j], q = other[(j + 1) % 3];
                        if ((p != a || q != b) && (p != b || q != a)) continue;
                        const double here = side_of(points[a].at, points[b].at, points[own[(k + 2) % 3]].at);
                        const double there = side_of(points[a].at, points[b].at, points[other[(j + 2) % 3]].at);
                        if (here * there < 0.0) found &= ~(1 << k);
                    }
                }
            }
            bits[f] = static_cast<uint8_t>(found);
        }
    });
    return bits;
}

// The numbers of the two edges of a triangle that a line meets, the smaller first, by which corners lie at its one side (bit
// k: corner k). Edge k leads from corner k to k + 1. Where all lie at one side, any two.
constexpr uint8_t kMet[8][2] = {{0, 1}, {0, 2}, {0, 1}, {1, 2}, {1, 2}, {0, 1}, {0, 2}, {0, 1}};

constexpr uint8_t kNext[4] = {0, 1, 2, 0};  // corners, in a circle

// What two neighbouring pixels see.
struct PixelPair {
    int32_t pixel[2], face[2];
    float depth[2];
};

// Looks for a silhouette of the nearer triangle between two neighbouring pixels that see different ones. A processor cannot
// guess what is found, so that both edges in question are computed, and one is chosen at the end, without branches.
class PairSearch {
public:
    explicit PairSearch(const AntialiasInput& in)
        : in_(in.shading), points_(in.shading.mesh.num_vertices), step_{1, in.shading.camera.width} {
        project_vertices(in_, points_);
        silhouettes_ = find_silhouettes(in, points_);
    }

    // The pixel (x, y) and its neighbour at the right (axis 0) or below (axis 1); of what both see, the pixels alone.
    PixelPair pair(int32_t x, int32_t y, int axis) const {
        const int32_t first = y * in_.camera.width + x;
        return {{first, first + step_[axis]}, {-1, -1}, {0.0f, 0.0f}};
    }

    // Writes the blend of such a pair, if there is one, and returns how many.
    int blend(int32_t x, int32_t y, int axis, const PixelPair& seen, Blend* blend) const {
        const int other = 1 - axis;
        const bool forward = (seen.face[1] < 0) | ((seen.face[0] >= 0) & (seen.depth[0] <= seen.depth[1]));
        const int32_t nearer = forward ? seen.face[0] : seen.face[1];
        const int silhouettes = silhouettes_[nearer];
        if (silhouettes == 0) return 0;  // of a welded mesh nearly always, of separate triangles never
        const int32_t* corner = in_.mesh.faces + 3 * static_cast<int64_t>(nearer);
        const int32_t at[2] = {x, y};
        const double along = at[axis] + (1.5 - forward), across = at[other] + 0.5;
        int side = 0;
        for (int k = 0; k < 3; ++k) side |= (points_[corner[k]].at[other] <= across) << k;
        const auto [met, then] = kMet[side];
        const EdgeCrossing crossings[2] = {crossing_of(corner, met, axis, along, across, forward),
                                           crossing_of(corner, then, axis, along, across, forward)};
        const bool meets = (side != 0) & (side != 7);
        const bool one = crossings[0].between & ((silhouettes >> met & 1) != 0);
        const bool two = crossings[1].between & ((silhouettes >> then & 1) != 0);
        const SilhouetteBlend found = blend_of(crossings[!one], forward);
        const int edge = one ? met : then;
        blend->to = seen.pixel[found.into_second];
        blend->from = seen.pixel[!found.into_second];
        blend->weight = found.weight;
        for (int end = 0; end < 2; ++end) {
            blend->vertex[end] = corner[kNext[edge + end]];
            blend->derivative[end][axis] = found.by_along[end];
            blend->derivative[end][other] = found.by_across[end];
        }
        return meets & (one | two);
    }

private:
    EdgeCrossing crossing_of(const int32_t* corner, int edge, int axis, double along, double across, bool forward) const {
        return edge_crossing(points_[corner[edge]].at, points_[corner[kNext[edge + 1]]].at, axis, along, across, forward);
    }

    const ShadeInput& in_;
    Scratch<Point> points_;
    std::vector<uint8_t> silhouettes_;
    const int32_t step_[2];  // to the neighbour
};

// The pairs of row y that see different triangles, in their order: 2 x + axis for the pixel (x, y) and its neighbour at the
// right (axis 0) or below (axis 1). Returns how many.
int32_t different(const int32_t* triangle, const OpaqueCamera& camera, int32_t y, int32_t* pairs) {
    const int32_t width = camera.width;
    const int32_t* here = triangle + static_cast<int64_t>(y) * width;
    const int32_t* below = y + 1 < camera.height ? here + width : here;
    int32_t count = 0;
    for (int32_t x = 0; x < width; ++x) {
        pairs[count] = 2 * x;
        count += here[x] != here[x + 1 < width ? x + 1 : x];
        pairs[count] = 2 * x + 1;
        count += here[x] != below[x];
    }
    return count;
}

// Calls row(y, list) for every row of an image, with the list of its band: bands are looked through side by side.
template <class Row>
std::vector<std::vector<Blend>> in_bands(int32_t height, const Row& row) {
    const int32_t bands = (height + kRows - 1) / kRows;
    std::vector<std::vector<Blend>> lists(bands);
    parallel_for(bands, 1, [&](int64_t begin, int64_t end) {
        for (int64_t band = begin; band < end; ++band) {
            const auto top = static_cast<int32_t>(band) * kRows;
            for (int32_t y = top; y < std::min(top + kRows, height); ++y) row(y, lists[band]);
        }
    });
    return lists;
}

}  // namespace

std::vector<std::vector<Blend>> find_blends(const AntialiasInput& in) {
    const PairSearch search(in);
    const OpaqueCamera& camera = in.shading.camera;
    return in_bands(camera.height, [&](int32_t y, std::vector<Blend>& list) {
        Scratch<Blend> found(2 * int64_t{camera.width} + 1);  // of a row, and one that is none
        Scratch<int32_t> pairs(2 * int64_t{camera.width} + 1);
        const int32_t count = different(in.shading.triangle, camera, y, pairs.data());
        Blend* next = found.data();
        for (int32_t i = 0; i < count; ++i) {
            const int32_t x = pairs[i] / 2, axis = pairs[i] % 2;
            PixelPair seen = search.pair(x, y, axis);
            for (int k = 0; k < 2; ++k) {
                seen.face[k] = in.shading.triangle[seen.pixel[k]];
                seen.depth[k] = in.depth[seen.pixel[k]];
            }
            next += search.blend(x, y, axis, seen, next);
        }
        list.insert(list.end(), found.data(), next);
    });
}

std::vector<std::vector<Blend>> find_blends_behind(const AntialiasInput& in, const AntialiasInput& behind) {
    const PairSearch search(in);
    const OpaqueCamera& camera = in.shading.camera;
    return in_bands(camera.height, [&](int32_t y, std::vector<Blend>& list) {
        Scratch<Blend> found(4 * int64_t{camera.width} + 1);
        Blend* next = found.data();
        for (int32_t i = 0; i < 2 * camera.width; ++i) {
            const int32_t x = i / 2, axis = i % 2;
            if (axis == 0 ? x + 1 == camera.width : y + 1 == camera.height) continue;
            PixelPair seen = search.pair(x, y, axis);
            const int parts[2] = {opaque_part(in.shading.triangle[seen.pixel[0]]),
                                  opaque_part(in.shading.triangle[seen.pixel[1]])};
            for (int of = 0; of < (parts[0] == parts[1] ? 1 : 2); ++of) {  // the picture without that pixel's part
                if (parts[of] < 0) continue;
                for (int k = 0; k < 2; ++k) {
                    const AntialiasInput& shown = parts[k] == parts[of] ? behind : in;
                    seen.face[k] = shown.shading.triangle[seen.pixel[k]];
                    seen.depth[k] = shown.depth[seen.pixel[k]];
                }
                if (seen.face[0] == seen.face[1]) continue;
                if (search.blend(x, y, axis, seen, next) == 0) continue;
                next += opaque_part(in.shading.triangle[next->to]) == parts[of];
            }
        }
        list.insert(list.end(), found.data(), next);
    });
}

}  // namespace etsplat
