#include "bvh.h"

#include <limits>
#include <utility>

#include "parallel.h"

namespace etsplat {
namespace {

constexpr double infinity = std::numeric_limits<double>::infinity();
constexpr Box nothing{{infinity, infinity, infinity}, {-infinity, -infinity, -infinity}};

Box join(const Box& a, const Box& b) { return {min(a.low, b.low), max(a.high, b.high)}; }

Box bounds(const Triangle& t) {
    return {min(min(t.corner[0], t.corner[1]), t.corner[2]), max(max(t.corner[0], t.corner[1]), t.corner[2])};
}

double segment_squared_distance(Vec3 a, Vec3 b, Vec3 p) {
    const Vec3 along = b - a, offset = p - a;
    const double length2 = dot(along, along);
    const double t = length2 > 0 ? std::clamp(dot(offset, along) / length2, 0.0, 1.0) : 0.0;
    const Vec3 gap = offset - t * along;
    return dot(gap, gap);
}

}  // namespace

double squared_distance(const Triangle& t, Vec3 p) {
    const auto& [a, b, c] = t.corner;
    const Vec3 ab = b - a, ac = c - a, bc = c - b, ap = p - a;
    const Vec3 normal = cross(ab, ac);
    const double normal2 = dot(normal, normal);
    const double longest2 = std::max({dot(ab, ab), dot(ac, ac), dot(bc, bc)});
    // A triangle of relative height below 1e-12 has no direction to trust; its edges are as near as its inside.
    if (normal2 > 1e-24 * longest2 * longest2) {
        const double weight_b = dot(cross(ap, ac), normal), weight_c = dot(cross(ab, ap), normal);
        if (weight_b >= 0 && weight_c >= 0 && weight_b + weight_c <= normal2) {
            const double height = dot(ap, normal);
            return height * height / normal2;
        }
    }
    return std::min({segment_squared_distance(a, b, p), segment_squared_distance(b, c, p),
                     segment_squared_distance(c, a, p)});
}

Bvh::Bvh(const double* vertices, const int64_t* faces, int64_t num_faces) {
    std::vector<Box> boxes(num_faces);
    std::vector<Centered> order(num_faces);
    for (int64_t f = 0; f < num_faces; ++f) {
        boxes[f] = bounds(triangle(vertices, faces + 3 * f));
        order[f] = {boxes[f].low + boxes[f].high, f};
    }
    nodes_.reserve(num_faces);
    build(0, num_faces, order, boxes);
    triangles_.reserve(num_faces);
    boxes_.reserve(num_faces);
    faces_.reserve(num_faces);
    for (const Centered& at : order) {
        triangles_.push_back(triangle(vertices, faces + 3 * at.face));
        boxes_.push_back(boxes[at.face]);
        faces_.push_back(at.face);
    }
}

int32_t Bvh::build(int64_t begin, int64_t end, std::vector<Centered>& order, const std::vector<Box>& boxes) {
    const int32_t index = static_cast<int32_t>(nodes_.size());
    nodes_.push_back({nothing, static_cast<int32_t>(begin), static_cast<int32_t>(end), 0});
    if (end - begin <= leaf_size) {
        for (int64_t slot = begin; slot < end; ++slot) nodes_[index].box = join(nodes_[index].box, boxes[order[slot].face]);
        leaves_.push_back(index);
        return index;
    }
    Box centers = nothing;
    for (int64_t slot = begin; slot < end; ++slot) {
        centers = join(centers, {order[slot].twice_center, order[slot].twice_center});
    }
    const Vec3 extent = centers.high - centers.low;
    double Vec3::*const axis = extent.x >= extent.y && extent.x >= extent.z ? &Vec3::x
                               : extent.y >= extent.z                       ? &Vec3::y
                                                                            : &Vec3::z;
    const int64_t middle = begin + (end - begin) / 2;
    std::nth_element(order.begin() + begin, order.begin() + middle, order.begin() + end,
                     [axis](const Centered& a, const Centered& b) {
                         const double first = a.twice_center.*axis, second = b.twice_center.*axis;
                         return first != second ? first < second : a.face < b.face;
                     });
    build(begin, middle, order, boxes);
    const int32_t right = build(middle, end, order, boxes);
    nodes_[index].right = right;
    nodes_[index].box = join(nodes_[index + 1].box, nodes_[right].box);
    return index;
}

void Bvh::move(const double* vertices, const int64_t* faces) {
    parallel_for(static_cast<int64_t>(faces_.size()), 4096, [&](int64_t begin, int64_t end) {
        for (int64_t slot = begin; slot < end; ++slot) {
            triangles_[slot] = triangle(vertices, faces + 3 * faces_[slot]);
            boxes_[slot] = bounds(triangles_[slot]);
        }
    });
    for (int64_t index = static_cast<int64_t>(nodes_.size()) - 1; index >= 0; --index) {  // children lie behind parents
        Node& node = nodes_[index];
        node.box = node.right ? join(nodes_[index + 1].box, nodes_[node.right].box) : nothing;
        for (int32_t slot = node.begin; !node.right && slot < node.end; ++slot) node.box = join(node.box, boxes_[slot]);
    }
}

Bvh::Chosen Bvh::choose(const uint8_t* faces) const {
    Chosen found{std::vector<uint8_t>(faces_.size()), {0}};
    found.before.reserve(faces_.size() + 1);
    for (size_t slot = 0; slot < faces_.size(); ++slot) {
        found.chosen[slot] = !faces || faces[faces_[slot]];
        found.before.push_back(found.before.back() + found.chosen[slot]);
    }
    return found;
}

Bvh::Nearest Bvh::nearest(Vec3 p) const {
    std::pair<double, int32_t> stack[max_depth];
    int depth = 0;
    stack[depth++] = {nodes_[0].box.squared_distance(p), 0};
    Nearest best{infinity, -1};
    while (depth > 0) {
        const auto [bound, index] = stack[--depth];
        if (bound > best.squared_distance) continue;
        const Node& node = nodes_[index];
        if (node.right) {
            std::pair<double, int32_t> near{nodes_[index + 1].box.squared_distance(p), index + 1};
            std::pair<double, int32_t> far{nodes_[node.right].box.squared_distance(p), node.right};
            if (far.first < near.first) std::swap(near, far);
            stack[depth++] = far;
            stack[depth++] = near;
            continue;
        }
        for (int32_t slot = node.begin; slot < node.end; ++slot) {
            if (boxes_[slot].squared_distance(p) > best.squared_distance) continue;
            const Nearest found{squared_distance(triangles_[slot], p), faces_[slot]};
            if (std::pair(found.squared_distance, found.face) < std::pair(best.squared_distance, best.face)) {
                best = found;
            }
        }
    }
    return best;
}

}  // namespace etsplat
