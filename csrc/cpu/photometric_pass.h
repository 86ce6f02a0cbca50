// The data of one photometric loss and the interface of its loop, which exists once per instruction set
// (simd/photometric.h).
#pragma once

#include <cstdint>

#include "math/portable.h"

namespace etsplat {

constexpr int64_t kBandRows = 32;  // rows of an image whose values are summed together

struct PhotometricPass {
    const float* color;   // (B, H, W, 3)
    const void* target;   // (B, H, W, channels), bytes or floats; four channels are premultiplied RGBA
    const float* backgrounds;  // (B, 3) behind a transparent target; null is black
    const float* mask;    // (B, H, W), or null: 1 everywhere
    float* gradient;      // (B, H, W, 3), or null
    int64_t height, width;
    int channels;
    bool bytes;
    bool squared;         // the pixel term is a square rather than an absolute value
    float pixel_weight, ssim_weight;  // of one value in the gradient
};

struct PhotometricSums {
    double pixel, ssim;
};

struct PhotometricKernels {
    // Rows first .. last - 1 in one sweep; `sums`, zeros at first, are those of each kBandRows of them.
    using Sweep = void (*)(const PhotometricPass&, int64_t view, int64_t first, int64_t last, float* scratch,
                           PhotometricSums* sums);
    Sweep sweep;
};

// floats
ETSPLAT_FN int64_t photometric_scratch_size(int64_t width) {
    constexpr int64_t taps = 11, pad = 30;
    const int64_t n = 3 * width;
    return 2 * taps * (n + pad) + 7 * taps * n + 5 * (n + pad) + 5 * n;
}

}  // namespace etsplat
