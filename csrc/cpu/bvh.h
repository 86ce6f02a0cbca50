// Bounding volume hierarchy over the faces of a triangle mesh, in double precision.
//
// A binary tree of axis-aligned boxes, split at the median centre along the longest axis of the centres' box, so that
// its depth is logarithmic for any input. Nodes lie in depth-first order (the left child follows its parent); the
// triangles are copied in leaf order, so that a leaf reads one run of memory. Building is serial, O(F log F); queries
// change nothing and may run from any number of threads.
#pragma once

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

Box bounds(const Triangle& t);

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

    // The face nearest to p; of faces at the same computed distance the one with the smallest index.
    Nearest nearest(Vec3 p) const;

    // Triangles in leaf order ("slots") and the faces they come from.
    const std::vector<Triangle>& triangles() const { return triangles_; }
    const std::vector<int64_t>& faces() const { return faces_; }

    // Calls visit(slot) for every slot > after whose leaf's box meets `box`.
    template <class Visit>
    void overlapping(const Box& box, int64_t after, Visit&& visit) const;

private:
    struct Node {
        Box box;
        int32_t begin, end;  // its slots
        int32_t right;       // index of the right child; 0 in a leaf
    };
    static constexpr int leaf_size = 8;
    static constexpr int max_depth = 64;  // halving 2^31 slots takes 31

    int32_t build(int64_t begin, int64_t end, const std::vector<Box>& boxes);

    std::vector<Node> nodes_;
    std::vector<Triangle> triangles_;
    std::vector<int64_t> faces_;
};

template <class Visit>
void Bvh::overlapping(const Box& box, int64_t after, Visit&& visit) const {
    int32_t stack[max_depth];
    int depth = 0;
    stack[depth++] = 0;
    while (depth > 0) {
        const int32_t index = stack[--depth];
        const Node& node = nodes_[index];
        if (node.end <= after + 1 || !node.box.overlaps(box)) continue;
        if (node.right) {
            stack[depth++] = node.right;
            stack[depth++] = index + 1;
            continue;
        }
        for (int64_t slot = std::max<int64_t>(node.begin, after + 1); slot < node.end; ++slot) visit(slot);
    }
}

}  // namespace etsplat
