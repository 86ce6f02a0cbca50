// One value of a photometric loss: a channel against a premultiplied target over a background.
#pragma once

#include "portable.h"

namespace etsplat {

// A value of an image in [0, 1].
ETSPLAT_FN float unit_value(float value) { return value; }
ETSPLAT_FN float unit_value(unsigned char value) { return static_cast<float>(value) * (1.0f / 255.0f); }

// `rest` = 1 - alpha.
ETSPLAT_FN float over_background(float premultiplied, float rest, float background) {
    return premultiplied + rest * background;
}

// Derivative of scale |difference| by the difference, 0 at 0.
ETSPLAT_FN float l1_gradient(float difference, float scale) {
    return difference > 0.0f ? scale : difference < 0.0f ? -scale : 0.0f;
}

}  // namespace etsplat
