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

// Looks for a silhouette of the nearer triangle between two neighbouring pixels that see different ones.
class PairSearch {
public:
    PairSearch(const AntialiasInput& in, const Scratch<Point>& points, const std::vector<uint8_t>& silhouettes)
        : in_(in.shading), depth_(in.depth), points_(points), silhouettes_(silhouettes) {}

    // The pair is the pixel (x, y) and its neighbour at the right (axis 0) or below (axis 1).
    void visit(int32_t x, int32_t y, int axis, std::vector<Blend>& blends) const {
        const int32_t first = y * in_.camera.width + x, second = axis == 0 ? first + 1 : first + in_.camera.width;
        const int32_t face[2] = {in_.triangle[first], in_.triangle[second]};
        if (face[0] == face[1]) return;
        const bool forward = face[1] < 0 || (face[0] >= 0 && depth_[first] <= depth_[second]);
        const int32_t nearer = face[forward ? 0 : 1];
        const int silhouettes = silhouettes_[nearer];
        if (silhouettes == 0) return;
        const int32_t* corner = in_.mesh.faces + 3 * static_cast<int64_t>(nearer);
        const double along = (axis == 0 ? x : y) + (forward ? 0.5 : 1.5), across = (axis == 0 ? y : x) + 0.5;
        for (int k = 0; k < 3; ++k) {
            if (!(silhouettes >> k & 1)) continue;
            const int32_t ends[2] = {corner[k], corner[(k + 1) % 3]};
            if (add(ends, axis, along, across, forward, first, second, blends)) return;
        }
    }

private:
    bool add(const int32_t* ends, int axis, double along, double across, bool forward, int32_t first, int32_t second,
             std::vector<Blend>& blends) const {
        SilhouetteBlend found;
        if (!silhouette_blend(points_[ends[0]].at, points_[ends[1]].at, axis, along, across, forward, found)) return false;
        Blend blend;
        blend.to = found.into_second ? second : first;
        blend.from = found.into_second ? first : second;
        blend.weight = found.weight;
        for (int end = 0; end < 2; ++end) {
            blend.vertex[end] = ends[end];
            for (int i = 0; i < 2; ++i) blend.derivative[end][i] = found.derivative[end][i];
        }
        blends.push_back(blend);
        return true;
    }

    const ShadeInput& in_;
    const float* depth_;
    const Scratch<Point>& points_;
    const std::vector<uint8_t>& silhouettes_;
};

}  // namespace

std::vector<Blend> find_blends(const AntialiasInput& in) {
    Scratch<Point> points(in.shading.mesh.num_vertices);
    project_vertices(in.shading, points);
    const std::vector<uint8_t> silhouettes = find_silhouettes(in, points);
    const PairSearch search(in, points, silhouettes);
    const int32_t width = in.shading.camera.width, height = in.shading.camera.height, bands = (height + kRows - 1) / kRows;
    std::vector<std::vector<Blend>> lists(bands);
    parallel_for(bands, 1, [&](int64_t begin, int64_t end) {
        for (int64_t band = begin; band < end; ++band) {
            const auto top = static_cast<int32_t>(band) * kRows;
            for (int32_t y = top; y < std::min(top + kRows, height); ++y) {
                for (int32_t x = 0; x < width; ++x) {
                    if (x + 1 < width) search.visit(x, y, 0, lists[band]);
                    if (y + 1 < height) search.visit(x, y, 1, lists[band]);
                }
            }
        }
    });
    std::vector<Blend> blends;
    for (const std::vector<Blend>& list : lists) blends.insert(blends.end(), list.begin(), list.end());
    return blends;
}

}  // namespace etsplat
