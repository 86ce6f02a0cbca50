// Z-buffer rasterization of opaque triangles: ground truth, previews, the sharp rendering of a finished mesh.
#pragma once

#include <cstdint>

namespace etsplat {

struct OpaqueMesh {
    const float* vertices;  // (num_vertices, 3)
    const int32_t* faces;   // (num_faces, 3)
    int64_t num_vertices;
    int64_t num_faces;
};

struct OpaqueCamera {
    const float* viewmat;  // (4, 4) world to camera
    const float* K;        // (3, 3) in pixels
    float near_plane;
    int32_t width, height;
};

struct OpaqueColors {
    const float* faces;     // (num_faces, channels), or null
    const float* vertices;  // (num_vertices, channels), used if `faces` is null
    int32_t channels;
};

// What is seen at every pixel centre, (height, width, ...).
struct OpaqueImages {
    int32_t* triangle;    // -1: none
    float* barycentrics;  // 3 of it, perspective-correct; or null
    float* depth;
};

// The nearest triangle.
void rasterize_opaque(const OpaqueMesh& mesh, const OpaqueCamera& camera, const OpaqueImages& nearest);

constexpr int kOpaqueParts = 3;

// Of that, or of none (-1).
inline int opaque_part(int32_t face) { return face < 0 ? -1 : face % kOpaqueParts; }

// The nearest triangle, and the nearest of the other parts, where triangles are dealt into parts.
void rasterize_behind(const OpaqueMesh& mesh, const OpaqueCamera& camera, const OpaqueImages& nearest,
                      const OpaqueImages& behind);

// Where lines of sight through pixel centres meet a triangle first that does not turn its back, the triangle, and the nearest
// that does, which lies behind it; -1 where either is missing. turned (num_faces,) says which do.
void enter_and_leave(const OpaqueMesh& mesh, const OpaqueCamera& camera, const bool* turned, int64_t* entered,
                     int64_t* left);

// Mean over supersampling^2 samples a pixel: premultiplied colour and coverage, (height, width, channels + 1).
void render_opaque(const OpaqueMesh& mesh, const OpaqueCamera& camera, const OpaqueColors& colors,
                   int32_t supersampling, bool cull_backfaces, float* image);

}  // namespace etsplat
