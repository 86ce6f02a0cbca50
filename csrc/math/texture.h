// Formulas of texture sampling with their derivatives: where a coordinate lies between the centres of two texels, which
// levels a level of detail lies between, and which one the footprint of a pixel asks for.
//
// (0, 0) is the upper left corner of the texture, (1, 1) its lower right one; beyond them its border goes on.
#pragma once

#include "antialias.h"
#include "triangle.h"

namespace etsplat {

// A texture and its coarser levels, each one the means of 2 x 2 texels of the one before: sides are halved exactly.
struct Texture {
    const float *base, *coarser;  // (height, width, channels); levels 1, 2, ... one after the other
    int width, height, channels, levels;
};

// Where level 1, 2, ... begins among the coarser ones, in texels: width height (1/4 + 1/16 + ...).
ETSPLAT_FN long long coarser_offset(int width, int height, int level) {
    const long long texels = static_cast<long long>(width) * height;
    return (texels - (texels >> (2 * (level - 1)))) / 3;
}

ETSPLAT_FN const float* level_texels(const Texture& t, int level) {
    return level == 0 ? t.base : t.coarser + coarser_offset(t.width, t.height, level) * t.channels;
}

// A texel of a coarser level, from the four that it lies over.
ETSPLAT_FN float texel_mean(float a, float b, float c, float d) { return 0.25f * ((a + b) + (c + d)); }

// Along one axis of a level.
struct Between {
    int first, second;  // texels
    float fraction;     // from the centre of the first (0) to that of the second (1)
    float slope;        // d fraction / d coordinate; 0 beyond the centres of the border, and for NaN
};

ETSPLAT_FN Between between(float coordinate, int size) {
    const float position = coordinate * static_cast<float>(size) - 0.5f, last = static_cast<float>(size - 1);
    const bool inside = position > 0.0f && position < last;
    const float clamped = inside ? position : position > 0.0f ? last : 0.0f;
    Between b;
    b.first = static_cast<int>(clamped);
    b.second = b.first + 1 < size ? b.first + 1 : size - 1;
    b.fraction = clamped - static_cast<float>(b.first);
    b.slope = inside ? static_cast<float>(size) : 0.0f;
    return b;
}

// A sample's place in one level, and the level's weight.
struct LevelSample {
    int level;
    Between x, y;
    float weight;

    // Of the texels (first, first), (second, first), (first, second), (second, second) in x, y.
    ETSPLAT_FN void weights(float* w) const {
        const float upper = weight * (1.0f - y.fraction), lower = weight * y.fraction;
        w[0] = upper * (1.0f - x.fraction);
        w[1] = upper * x.fraction;
        w[2] = lower * (1.0f - x.fraction);
        w[3] = lower * x.fraction;
    }
    // Where these texels are, in texels.
    ETSPLAT_FN void places(int width, long long* at) const {
        const long long upper = static_cast<long long>(y.first) * width, lower = static_cast<long long>(y.second) * width;
        at[0] = upper + x.first;
        at[1] = upper + x.second;
        at[2] = lower + x.first;
        at[3] = lower + x.second;
    }
};

// The levels that a sample lies between: one, or two where there is a fraction.
struct Levels {
    int first, count;
    float fraction;  // from the first to the second
};

ETSPLAT_FN Levels find_levels(const Texture& t, float lod) {
    const float last = static_cast<float>(t.levels - 1);
    const float clamped = lod > 0.0f ? (lod < last ? lod : last) : 0.0f;
    const int level = static_cast<int>(clamped);
    const float fraction = clamped - static_cast<float>(level);
    return {level, fraction > 0.0f ? 2 : 1, fraction};
}

ETSPLAT_FN LevelSample sample_level(const Texture& t, const Levels& levels, int i, float u, float v) {
    const int level = levels.first + i;
    return {level, between(u, t.width >> level), between(v, t.height >> level),
            i == 0 ? 1.0f - levels.fraction : levels.fraction};
}

// values (channels) of one sample
ETSPLAT_FN void sample_texture(const Texture& t, float u, float v, float lod, float* values) {
    const Levels levels = find_levels(t, lod);
    for (int c = 0; c < t.channels; ++c) values[c] = 0.0f;
    for (int i = 0; i < levels.count; ++i) {
        const LevelSample s = sample_level(t, levels, i, u, v);
        const float* texels = level_texels(t, s.level);
        float w[4];
        long long at[4];
        s.weights(w);
        s.places(t.width >> s.level, at);
        for (int c = 0; c < t.channels; ++c) {
            float value = w[0] * texels[at[0] * t.channels + c];
            for (int k = 1; k < 4; ++k) value += w[k] * texels[at[k] * t.channels + c];
            values[c] += value;
        }
    }
}

// Gradient by u, v from that of the values.
ETSPLAT_FN void sample_texture_backward(const Texture& t, float u, float v, float lod, const float* grad,
                                        float* grad_uv) {
    const Levels levels = find_levels(t, lod);
    grad_uv[0] = grad_uv[1] = 0.0f;
    for (int i = 0; i < levels.count; ++i) {
        const LevelSample s = sample_level(t, levels, i, u, v);
        const float* texels = level_texels(t, s.level);
        long long at[4];
        s.places(t.width >> s.level, at);
        float by_x = 0.0f, by_y = 0.0f;
        for (int c = 0; c < t.channels; ++c) {
            float texel[4];
            for (int k = 0; k < 4; ++k) texel[k] = texels[at[k] * t.channels + c];
            by_x += grad[c] * ((1.0f - s.y.fraction) * (texel[1] - texel[0]) + s.y.fraction * (texel[3] - texel[2]));
            by_y += grad[c] * ((1.0f - s.x.fraction) * (texel[2] - texel[0]) + s.x.fraction * (texel[3] - texel[1]));
        }
        grad_uv[0] += s.weight * s.x.slope * by_x;
        grad_uv[1] += s.weight * s.y.slope * by_y;
    }
}

// How the ray through a pixel, with z = 1 in the camera's frame, turns in world space with the pixel's x and y.
struct RayTurn {
    Vector3<double> x, y;
};

ETSPLAT_FN RayTurn ray_turn(const PinholeCamera& camera) {
    const float* r = camera.rotation;
    const double x = 1.0 / camera.fx, y = 1.0 / camera.fy;
    return {{x * r[0], x * r[1], x * r[2]}, {y * r[3], y * r[4], y * r[5]}};
}

// Level of detail at which a texel is as wide as the longer of the steps that texture coordinates make from a pixel to
// its neighbours (Williams 1983, as OpenGL has it), at least 0. With V as in ViewInverse and the pixel's depth
// z = 1 / sum(beta): d b_k = z (row_k . dr - b_k sum_j row_j . dr). uvs (3, 2) are those of the corners.
ETSPLAT_FN float level_of_detail(const ViewInverse<double>& inverse, const RayTurn& turn, const float* barycentrics,
                                 const float* uvs, float depth, int width, int height) {
    double longest = 0.0;
    for (int axis = 0; axis < 2; ++axis) {
        double step[2] = {0.0, 0.0};
        double turned[3], total = 0.0;
        for (int k = 0; k < 3; ++k) {
            turned[k] = depth * dot(inverse.row[k], axis == 0 ? turn.x : turn.y);
            total += turned[k];
        }
        for (int k = 0; k < 3; ++k) {
            const double moved = turned[k] - barycentrics[k] * total;
            step[0] += moved * uvs[2 * k];
            step[1] += moved * uvs[2 * k + 1];
        }
        const double x = step[0] * width, y = step[1] * height, squared = x * x + y * y;
        if (squared > longest) longest = squared;
    }
    return longest > 1.0 ? 0.5f * vlog2(static_cast<float>(longest < 1e30 ? longest : 1e30)) : 0.0f;
}

}  // namespace etsplat
