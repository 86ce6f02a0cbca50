// Silhouette antialiasing of a shaded z-buffer image, with gradients.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "shading.h"

namespace etsplat {

// One view. Images are (height, width, ...).
struct AntialiasInput {
    ShadeInput shading;
    const int32_t* pair_offsets;  // (num_faces + 1): where the partners of each face start in `paired_faces`
    const int32_t* paired_faces;  // faces that share an edge
    const float* depth;
};

// A pixel gets weight * (colour of `from` - its own).
struct Blend {
    int32_t to, from;       // pixels
    int32_t vertex[2];      // ends of the silhouette edge
    float weight;
    float derivative[2][2];  // of the weight by the ends' screen x, y
};

// Every silhouette of the nearer triangle between two neighbouring pixels that see different ones, row by row, in lists
// that follow each other.
std::vector<std::vector<Blend>> find_blends(const AntialiasInput& input);

// Of the pictures without a part of the triangles each, the blends into the pixels in which one of these is the nearest
// (`rasterize_behind`). `from` has the colour of what is behind where it is of that part, too, else that of the nearest.
std::vector<std::vector<Blend>> find_blends_behind(const AntialiasInput& nearest, const AntialiasInput& behind);

struct AntialiasState {
    std::vector<std::vector<Blend>> blends;
};

struct AntialiasGradients {
    const float* color;   // (height, width, channels) cotangent of the image
    const float* shaded;  // as the forward pass left it
    float* grad_shaded;   // (height, width, channels) scratch
    ShadeGradients into;
};

// Fills `shaded` (before antialiasing) and `color` (after).
std::shared_ptr<AntialiasState> antialias_forward(const AntialiasInput& input, float* shaded, float* color);

// What pixels show without the part of the triangles that the nearest one belongs to; where there is none, what is behind
// all. `shaded` are the colours of the nearest triangles, before antialiasing. The mesh has no shared edges.
void antialias_behind(const AntialiasInput& nearest, const AntialiasInput& behind, const float* shaded, float* shaded_behind,
                      float* color);

// `input` is that of the forward pass, wherever it lies now.
void antialias_backward(const AntialiasState& state, const AntialiasInput& input, const AntialiasGradients& gradients);

}  // namespace etsplat
