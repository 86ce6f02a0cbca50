#include "flips.h"

#include <algorithm>
#include <cmath>
#include <unordered_set>

#include "vec3.h"

namespace etsplat {

namespace {

// Half a circle and a little, as the sum of the cotangents of two equal angles: rounding flips nothing there and back.
constexpr double kBeyondHalfCircle = -0.06;

double length(Vec3 a) { return std::sqrt(dot(a, a)); }

double cotangent(Vec3 apex, Vec3 a, Vec3 b) { return dot(a - apex, b - apex) / length(cross(a - apex, b - apex)); }

Vec3 across(Vec3 a, Vec3 b, Vec3 c) { return cross(b - a, c - a); }

bool alike(Vec3 a, Vec3 b, double least_cosine) { return dot(a, b) >= least_cosine * length(a) * length(b); }

uint64_t key(int64_t a, int64_t b) {
    return static_cast<uint64_t>(std::min(a, b)) << 32 | static_cast<uint64_t>(std::max(a, b));
}

// An edge from a to b as its first face runs along it, and what is beside it.
struct Quad {
    int64_t left, right;        // faces (a, b, c) and (b, a, d)
    int left_slot, right_slot;  // where the edge is in each
    int64_t a, b, c, d;
};

Quad quad_of(const EdgesOfMesh& mesh, int64_t edge) {
    Quad quad{};
    quad.left = mesh.edge_faces[2 * edge];
    quad.right = mesh.edge_faces[2 * edge + 1];
    const auto slot = [&](int64_t face) {
        return static_cast<int>(std::find(mesh.face_edges + 3 * face, mesh.face_edges + 3 * face + 2, edge) -
                                (mesh.face_edges + 3 * face));
    };
    quad.left_slot = slot(quad.left);
    quad.right_slot = slot(quad.right);
    const int64_t* left = mesh.faces + 3 * quad.left;
    quad.a = left[quad.left_slot];
    quad.b = left[(quad.left_slot + 1) % 3];
    quad.c = left[(quad.left_slot + 2) % 3];
    quad.d = mesh.faces[3 * quad.right + (quad.right_slot + 2) % 3];
    return quad;
}

bool is_better_turned(const double* vertices, const Quad& quad, double least_cosine) {
    const Vec3 a = vertex(vertices, quad.a), b = vertex(vertices, quad.b);
    const Vec3 c = vertex(vertices, quad.c), d = vertex(vertices, quad.d);
    if (!(cotangent(c, a, b) + cotangent(d, a, b) < kBeyondHalfCircle)) return false;  // nor where it is not a number
    const Vec3 left = across(a, b, c), right = across(b, a, d);
    const Vec3 new_left = across(c, d, b), new_right = across(d, c, a);
    return dot(new_left, new_left) > 0 && dot(new_right, new_right) > 0 && alike(left, right, least_cosine) &&
           alike(new_left, new_right, least_cosine) && alike(left + right, new_left, least_cosine) &&
           alike(left + right, new_right, least_cosine);
}

void flip(EdgesOfMesh mesh, int64_t edge, const Quad& quad) {
    int64_t* left = mesh.face_edges + 3 * quad.left;
    int64_t* right = mesh.face_edges + 3 * quad.right;
    const int64_t bc = left[(quad.left_slot + 1) % 3], ca = left[(quad.left_slot + 2) % 3];
    const int64_t ad = right[(quad.right_slot + 1) % 3], db = right[(quad.right_slot + 2) % 3];
    const auto fill = [](int64_t* row, int64_t x, int64_t y, int64_t z) { row[0] = x, row[1] = y, row[2] = z; };
    fill(mesh.faces + 3 * quad.left, quad.c, quad.d, quad.b);
    fill(mesh.faces + 3 * quad.right, quad.d, quad.c, quad.a);
    fill(left, edge, db, bc);
    fill(right, edge, ca, ad);
    std::replace(mesh.edge_faces + 2 * db, mesh.edge_faces + 2 * db + 2, quad.right, quad.left);
    std::replace(mesh.edge_faces + 2 * ca, mesh.edge_faces + 2 * ca + 2, quad.left, quad.right);
    mesh.edges[2 * edge] = quad.c;
    mesh.edges[2 * edge + 1] = quad.d;
    --mesh.valences[quad.a];
    --mesh.valences[quad.b];
    ++mesh.valences[quad.c];
    ++mesh.valences[quad.d];
}

}  // namespace

int64_t flip_edges(const double* vertices, EdgesOfMesh mesh, int64_t num_edges, double least_cosine, int rounds) {
    std::unordered_set<uint64_t> there;
    there.reserve(static_cast<size_t>(num_edges));
    for (int64_t e = 0; e < num_edges; ++e) there.insert(key(mesh.edges[2 * e], mesh.edges[2 * e + 1]));
    int64_t total = 0;
    for (int round = 0, flipped = 1; round < rounds && flipped > 0; ++round) {
        flipped = 0;
        for (int64_t e = 0; e < num_edges; ++e) {
            if (mesh.edge_faces[2 * e] < 0) continue;
            const Quad quad = quad_of(mesh, e);
            if (mesh.valences[quad.a] <= 3 || mesh.valences[quad.b] <= 3 || quad.c == quad.d) continue;
            if (!is_better_turned(vertices, quad, least_cosine) || there.count(key(quad.c, quad.d))) continue;
            there.erase(key(quad.a, quad.b));
            there.insert(key(quad.c, quad.d));
            flip(mesh, e, quad);
            ++flipped;
        }
        total += flipped;
    }
    return total;
}

}  // namespace etsplat
