// Sampling of textures with coarser levels, and its gradients.
#pragma once

#include <cstdint>

#include "math/texture.h"

namespace etsplat {

struct TextureSamples {
    const float* uv;   // (count, 2)
    const float* lod;  // (count), or null: level 0
    int64_t count;

    float detail(int64_t n) const { return lod ? lod[n] : 0.0f; }
    int levels(const Texture& texture, int64_t n, LevelSample* sample) const {
        const Levels found = find_levels(texture, detail(n));
        for (int i = 0; i < found.count; ++i) sample[i] = sample_level(texture, found, i, uv[2 * n], uv[2 * n + 1]);
        return found.count;
    }
};

// Fills the levels 1, 2, ... of a texture of so many levels, `coarser` being those of `texture`.
void build_levels(const Texture& texture, float* coarser);

// values (count, channels)
void sample_texture(const Texture& texture, const TextureSamples& samples, float* values);

// Gradient (count, 2) by the samples' places from that of the values.
void sample_texture_by_uv(const Texture& texture, const TextureSamples& samples, const float* grad_values,
                          float* grad_uv);

// Gradient (height, width, channels) by the texture, from which its coarser levels were built; `coarser` has room for
// theirs.
void sample_texture_by_texels(const Texture& texture, const TextureSamples& samples, const float* grad_values,
                              float* grad_base, float* grad_coarser);

}  // namespace etsplat
