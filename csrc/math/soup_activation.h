// From the parameters of a soup's triangle to the opacity and the softness that are drawn (etsplat/ops/soup_activation.py).
#pragma once

#include "triangle.h"

namespace etsplat {

constexpr float kSoupSigmaFloor = 0.01f;

// `dropout`: the share of the triangles that a draw leaves out by chance; `draw`: its number, a whole one below 2^24.
struct SoupNumbers {
    float opacity_floor, sigma_ceiling, dropout, draw;
};

// Pixels: of the incircle's radius, and of the distance from the mean of the vertices to the farthest.
struct SoupSizes {
    float smallest, largest;
};

struct Activated {
    float opacity, sigma;
};

ETSPLAT_FN float natural_exp(float x) { return vexp2(x * 1.4426950408889634f); }

ETSPLAT_FN Activated activate(float logit, float raw, SoupNumbers numbers) {
    const float sigmoid = 1.0f / (1.0f + natural_exp(-logit));
    return {numbers.opacity_floor + (1.0f - numbers.opacity_floor) * sigmoid,
            vmin(kSoupSigmaFloor + natural_exp(raw), numbers.sigma_ceiling)};
}

// From gradients by the activated numbers to those by the parameters; nothing passes the ceiling.
ETSPLAT_FN Activated activate_backward(float logit, float raw, SoupNumbers numbers, Activated grad) {
    const float sigmoid = 1.0f / (1.0f + natural_exp(-logit)), sharpness = natural_exp(raw);
    const bool cut = kSoupSigmaFloor + sharpness > numbers.sigma_ceiling;
    return {grad.opacity * (1.0f - numbers.opacity_floor) * sigmoid * (1.0f - sigmoid),
            cut ? 0.0f : grad.sigma * sharpness};
}

// Murmur3's finalizer: each bit of the result depends on all of x.
ETSPLAT_FN unsigned mixed_bits(unsigned x) {
    x = (x ^ (x >> 16)) * 0x85ebca6bu;
    x = (x ^ (x >> 13)) * 0xc2b2ae35u;
    return x ^ (x >> 16);
}

// Whether triangle n is left out by chance: another choice for each draw, and the same wherever it is made.
ETSPLAT_FN bool is_dropped(unsigned n, SoupNumbers numbers) {
    const unsigned bits = mixed_bits(n ^ mixed_bits(static_cast<unsigned>(numbers.draw)));
    return static_cast<float>(bits >> 8) * 0x1p-24f < numbers.dropout;
}

// Whether the projected triangle is too small, its incircle's radius being 2 area / perimeter, or too large. Vertices behind
// the camera are taken to lie just before it.
ETSPLAT_FN bool is_left_out(const PinholeCamera& camera, const float* world, SoupSizes sizes) {
    float x[3], y[3];
    for (int k = 0; k < 3; ++k) {
        float view[3];
        to_camera(camera, world + 3 * k, view);
        const float inverse_z = 1.0f / vmax(view[2], 1e-6f);
        x[k] = view[0] * inverse_z * camera.fx;
        y[k] = view[1] * inverse_z * camera.fy;
    }
    const float mean_x = (x[0] + x[1] + x[2]) * (1.0f / 3.0f), mean_y = (y[0] + y[1] + y[2]) * (1.0f / 3.0f);
    float perimeter = 0.0f, farthest = 0.0f;
    for (int k = 0; k < 3; ++k) {
        const float ex = x[(k + 1) % 3] - x[k], ey = y[(k + 1) % 3] - y[k], dx = x[k] - mean_x, dy = y[k] - mean_y;
        perimeter += vsqrt(ex * ex + ey * ey);
        farthest = vmax(farthest, dx * dx + dy * dy);
    }
    const float doubled_area = vabs((x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0]));
    return doubled_area < sizes.smallest * perimeter || vsqrt(farthest) > sizes.largest;
}

}  // namespace etsplat
