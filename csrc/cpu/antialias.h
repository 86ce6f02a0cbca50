// Shading and silhouette antialiasing of a z-buffer image, with gradients.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "math/triangle.h"
#include "rasterize_opaque.h"

namespace etsplat {

// One view. Images are (height, width, ...).
struct AntialiasInput {
    OpaqueMesh mesh;
    OpaqueCamera camera;
    const int32_t* pair_offsets;  // (num_faces + 1): where the partners of each face start in `paired_faces`
    const int32_t* paired_faces;  // faces that share an edge
    const int32_t* triangle;      // what `rasterize_opaque` found
    const float* barycentrics;
    const float* depth;
    OpaqueColors colors;
    const float* background;  // (channels)
};

// A pixel gets weight * (colour of `from` - its own).
struct Blend {
    int32_t to, from;       // pixels
    int32_t vertex[2];      // ends of the silhouette edge
    float weight;
    float derivative[2][2];  // of the weight by the ends' screen x, y
};

// Every silhouette of the nearer triangle between two neighbouring pixels that see different ones, row by row.
std::vector<Blend> find_blends(const AntialiasInput& input);

struct AntialiasState {
    std::vector<Blend> blends;
};

struct AntialiasGradients {
    const float* color;  // (height, width, channels) cotangent of the image
    const float* shaded;  // as the forward pass left it
    float* grad_shaded;  // (height, width, channels) scratch
    float* vertices;     // (num_vertices, 3), added to; or null
    float* colors;       // as the colours, added to; or null
    float* background;   // (channels), added to; or null
};

inline PinholeCamera pinhole(const OpaqueCamera& camera) {
    PinholeCamera p;
    for (int r = 0; r < 3; ++r) {
        for (int c = 0; c < 3; ++c) p.rotation[3 * r + c] = camera.viewmat[4 * r + c];
        p.translation[r] = camera.viewmat[4 * r + 3];
    }
    p.fx = camera.K[0];
    p.skew = camera.K[1];
    p.cx = camera.K[2];
    p.fy = camera.K[4];
    p.cy = camera.K[5];
    return p;
}

// Fills `shaded` (before antialiasing) and `color` (after).
std::shared_ptr<AntialiasState> antialias_forward(const AntialiasInput& input, float* shaded, float* color);

// `input` is that of the forward pass, wherever it lies now.
void antialias_backward(const AntialiasState& state, const AntialiasInput& input, const AntialiasGradients& gradients);

}  // namespace etsplat
