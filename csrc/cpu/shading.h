// Colours of pixels from what the z-buffer found, with gradients to colours, vertices and background.
#pragma once

#include <cstdint>

#include "math/antialias.h"
#include "math/triangle.h"
#include "rasterize_opaque.h"

namespace etsplat {

// One view. Images are (height, width, ...).
struct ShadeInput {
    OpaqueMesh mesh;
    OpaqueCamera camera;
    const int32_t* triangle;  // what `rasterize_opaque` found
    const float* barycentrics;
    const float* colors;  // (num_faces), (num_vertices), (num_faces, 3) or (height, width) times channels
    ColorsOf colors_of;
    int32_t channels;
    const float* background;  // (channels); null: 0

    // Where the colour of a corner lies.
    int64_t corner_color(int64_t face, int corner) const {
        const int64_t row = colors_of == ColorsOf::kCorners ? 3 * face + corner : mesh.faces[3 * face + corner];
        return row * channels;
    }
};

struct ShadeGradients {
    float* vertices;    // (num_vertices, 3), added to; or null
    float* colors;      // as the colours, added to; or null
    float* background;  // (channels), added to; or null
};

inline PinholeCamera pinhole(const OpaqueCamera& camera) { return pinhole_camera(camera.viewmat, camera.K); }

void shade(const ShadeInput& input, float* shaded);

// From the cotangent (height, width, channels) of the shaded image.
void shade_backward(const ShadeInput& input, const float* grad_shaded, const ShadeGradients& gradients);

// Level of detail (csrc/math/texture.h) of each pixel, 0 where there is no triangle; uvs (num_faces, 3, 2) are those of
// corners, in a texture of so many texels.
void texture_detail(const OpaqueMesh& mesh, const OpaqueCamera& camera, const int32_t* triangle,
                    const float* barycentrics, const float* depth, const float* uvs, int width, int height, float* lod);

}  // namespace etsplat
