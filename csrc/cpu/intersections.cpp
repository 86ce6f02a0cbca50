// Every leaf of the hierarchy asks it for the faces whose boxes meet those of its own, so that each pair is tested once.
// Marks are only ever set, so the result does not depend on the order in which threads set them.
#include "intersections.h"

#include <atomic>
#include <cmath>
#include <memory>

#include "parallel.h"
#include "predicates.h"

namespace etsplat {
namespace {

Vec2 drop(Vec3 v, int axis) { return axis == 0 ? Vec2{v.y, v.z} : axis == 1 ? Vec2{v.z, v.x} : Vec2{v.x, v.y}; }

int turn(const Triangle& t, int axis) {
    return orient2d(drop(t.corner[0], axis), drop(t.corner[1], axis), drop(t.corner[2], axis));
}

bool collinear(const Triangle& t) { return turn(t, 0) == 0 && turn(t, 1) == 0 && turn(t, 2) == 0; }

// Whether a line through an edge of s has all of t on its outer side, seen along an axis; two open convex polygons in a
// plane are disjoint exactly if an edge of one of them separates them so.
bool edge_separates(const Triangle& s, const Triangle& t, int axis) {
    const int inside = turn(s, axis);
    for (int k = 0; k < 3; ++k) {
        const Vec2 from = drop(s.corner[k], axis), to = drop(s.corner[(k + 1) % 3], axis);
        bool outside = true;
        for (const Vec3& corner : t.corner) outside = outside && orient2d(from, to, drop(corner, axis)) * inside <= 0;
        if (outside) return true;
    }
    return false;
}

bool coplanar_interiors_meet(const Triangle& s, const Triangle& t) {
    int axis = 0;
    while (turn(s, axis) == 0) ++axis;  // s is not collinear, so one of the three views shows its area
    return !edge_separates(s, t, axis) && !edge_separates(t, s, axis);
}

// How the corners of a triangle lie to a plane: the one that is alone on its side, if both sides are taken.
struct Sides {
    bool coplanar, crosses;
    int alone;
};

Sides sides_of(const Triangle& t, const Triangle& plane) {
    int side[3];
    for (int k = 0; k < 3; ++k) side[k] = orient3d(plane.corner[0], plane.corner[1], plane.corner[2], t.corner[k]);
    const bool above = side[0] > 0 || side[1] > 0 || side[2] > 0, below = side[0] < 0 || side[1] < 0 || side[2] < 0;
    int alone = 0;
    for (int k = 0; k < 3; ++k) {
        if (side[k] != 0 && side[k] * side[(k + 1) % 3] <= 0 && side[k] * side[(k + 2) % 3] <= 0) alone = k;
    }
    return {!above && !below, above && below, alone};
}

// A collinear triangle spans no plane: all others are coplanar with it, and it meets none.
bool interiors_meet(const Triangle& s, const Triangle& t) {
    const Sides s_sides = sides_of(s, t);
    if (s_sides.coplanar) return !collinear(s) && !collinear(t) && coplanar_interiors_meet(s, t);
    if (!s_sides.crosses) return false;
    const Sides t_sides = sides_of(t, s);
    if (!t_sides.crosses) return false;
    // Each triangle meets the line common to both planes in an interval that ends on its two edges at the lone corner.
    // The orientation of an edge of s with an edge of t says which of their two ends comes first along that line, so
    // the open intervals overlap exactly if both answers occur.
    bool before = false, after = false;
    for (int i = 1; i <= 2; ++i) {
        for (int j = 1; j <= 2; ++j) {
            const int order = orient3d(s.corner[s_sides.alone], s.corner[(s_sides.alone + i) % 3],
                                       t.corner[t_sides.alone], t.corner[(t_sides.alone + j) % 3]);
            before = before || order < 0;
            after = after || order > 0;
        }
    }
    return before && after;
}

}  // namespace

void mark_intersecting_faces(const Bvh& bvh, const uint8_t* again, uint8_t* intersecting) {
    const Bvh::Chosen chosen = bvh.choose(again);
    const auto& triangles = bvh.triangles();
    const auto num_faces = static_cast<int64_t>(triangles.size());
    const auto marks = std::make_unique<std::atomic<bool>[]>(num_faces);
    parallel_for(bvh.leaves(), 32, [&](int64_t begin, int64_t end) {
        for (int64_t leaf = begin; leaf < end; ++leaf) {
            bvh.meeting(leaf, chosen, [&](int32_t slot, int32_t other) {
                const bool known = marks[slot].load(std::memory_order_relaxed) &&
                                   marks[other].load(std::memory_order_relaxed);
                if (known) return;
                if (interiors_meet(triangles[slot], triangles[other])) {
                    marks[slot].store(true, std::memory_order_relaxed);
                    marks[other].store(true, std::memory_order_relaxed);
                }
            });
        }
    });
    for (int64_t slot = 0; slot < num_faces; ++slot) intersecting[bvh.faces()[slot]] = marks[slot].load();
}

std::vector<int64_t> overlapping_boxes(const Bvh& bvh) {
    const Bvh::Chosen all = bvh.choose(nullptr);
    std::vector<std::vector<int64_t>> found(bvh.leaves());
    parallel_for(bvh.leaves(), 32, [&](int64_t begin, int64_t end) {
        for (int64_t leaf = begin; leaf < end; ++leaf) {
            bvh.meeting(leaf, all, [&](int32_t slot, int32_t other) {
                found[leaf].push_back(bvh.faces()[slot]);
                found[leaf].push_back(bvh.faces()[other]);
            });
        }
    });
    std::vector<int64_t> pairs;
    size_t count = 0;
    for (const std::vector<int64_t>& own : found) count += own.size();
    pairs.reserve(count);
    for (std::vector<int64_t>& own : found) {
        pairs.insert(pairs.end(), own.begin(), own.end());
        std::vector<int64_t>().swap(own);
    }
    return pairs;
}

}  // namespace etsplat
