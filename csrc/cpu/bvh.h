// Bounding volume hierarchy over the faces of a triangle mesh, in double precision.
//
// A binary tree of axis-aligned boxes, split at the median centre along the longest axis of the centres' box, so that
// its depth is logarithmic for any input. Nodes lie in depth-first order (the left child follows its parent); the
// triangles and their boxes are copied in leaf order, so that a leaf reads one run of memory. Building is serial,
// O(F log F); queries change nothing and may run from any number of threads.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "vec3.h"

namespace etsplat {

struct Box {
    Vec3 low, high;

    bool overlaps(const Box& other) const {
        return low.x <= other.high.x && other.low.x <= high.x && low.y <= other.high.y && other.low.y <= high.y &&
               low.z <= other.high.z && other.low.z <= high.z;
    }
    double squared_distance(Vec3 p) const {
        const Vec3 outside = max(max(low - p, p - high), Vec3{0, 0, 0});
        return dot(outside, outside);
    }
};

// The squared distance from p to the triangle, any degenerate one (a segment, a point) included.
double squared_distance(const Triangle& t, Vec3 p);

class Bvh {
public:
    struct Nearest {
        double squared_distance;
        int64_t face;
    };

    // vertices: rows of 3; faces: rows of 3, num_faces >= 1. All coordinates finite.
    Bvh(const double* vertices, const int64_t* faces, int64_t num_faces);

    // Moves the same faces to where their vertices are now. The tree stays as it is, and is the worse the farther they moved.
    void move(const double* vertices, const int64_t* faces);

    // The face nearest to p; of faces at the same computed distance the one with the smallest index.
    Nearest nearest(Vec3 p) const;

    // Triangles in leaf order ("slots") and the faces they come from.
    const std::vector<Triangle>& triangles() const { return triangles_; }
    const std::vector<int64_t>& faces() const { return faces_; }

    // Leaves, which are runs of slots one behind the other.
    int64_t leaves() const { return static_cast<int64_t>(leaves_.size()); }

    // Some of the slots.
    struct Chosen {
        std::vector<uint8_t> chosen;  // of each slot
        std::vector<int32_t> before;  // how many of those before each slot are chosen, and of all
        bool all(int32_t begin, int32_t end) const { return before[end] - before[begin] == end - begin; }
    };
    // Those of which faces[f] is not 0; all if `faces` is null.
    Chosen choose(const uint8_t* faces) const;

    // Calls visit(slot, other) for chosen slots of that leaf and all others whose boxes meet theirs; over all leaves that
    // is every such pair of which one at least is chosen, once.
    template <class Visit>
    void meeting(int64_t leaf, const Chosen& chosen, Visit&& visit) const;

private:
    struct Centered {
        Vec3 twice_center;  // of a face's box
        int64_t face;
    };
    struct Node {
        Box box;
        int32_t begin, end;  // its slots
        int32_t right;       // index of the right child; 0 in a leaf
    };
    static constexpr int leaf_size = 8;
    static constexpr int max_depth = 64;  // halving 2^31 slots takes 31

    int32_t build(int64_t begin, int64_t end, std::vector<Centered>& order, const std::vector<Box>& boxes);

    // Calls visit(leaf) for every leaf that, as all above it, is asked for.
    template <class Asked, class Visit>
    void descend(Asked&& asked, Visit&& visit) const;

    std::vector<Node> nodes_;
    std::vector<int32_t> leaves_;  // indices of nodes
    std::vector<Triangle> triangles_;
    std::vector<Box> boxes_;
    std::vector<int64_t> faces_;
};

template <class Asked, class Visit>
void Bvh::descend(Asked&& asked, Visit&& visit) const {
    int32_t stack[max_depth];
    int depth = 0;
    stack[depth++] = 0;
    while (depth > 0) {
        const int32_t index = stack[--depth];
        const Node& node = nodes_[index];
        if (!asked(node)) continue;
        if (node.right) {
            stack[depth++] = node.right;
            stack[depth++] = index + 1;
        } else {
            visit(node);
        }
    }
}

template <class Visit>
void Bvh::meeting(int64_t leaf, const Chosen& chosen, Visit&& visit) const {
    const Node& here = nodes_[leaves_[leaf]];
    if (chosen.before[here.begin] == chosen.before[here.end]) return;
    const auto asked = [&](const Node& node) {
        if (node.end <= here.begin && chosen.all(node.begin, node.end)) return false;  // those ask for these
        return node.box.overlaps(here.box);
    };
    descend(asked, [&](const Node& node) {
        for (int32_t slot = here.begin; slot < here.end; ++slot) {
            const Box& box = boxes_[slot];
            if (!chosen.chosen[slot] || !node.box.overlaps(box)) continue;
            for (int32_t other = node.begin; other < node.end; ++other) {
                if (other == slot || (other < slot && chosen.chosen[other])) continue;
                if (box.overlaps(boxes_[other])) visit(slot, other);
            }
        }
    });
}

}  // namespace etsplat
