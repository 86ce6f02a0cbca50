#include "halving_sums.h"

#include "prefetch.h"

namespace etsplat {
namespace {

constexpr int64_t kAhead = 8;  // pixels: their sums lie anywhere in memory

}  // namespace

void add_halving_sums(const HalvingPixels& pixels, const int64_t* longest, float* sums) {
    for (int64_t p = 0; p < pixels.size; ++p) {
        if (p + kAhead < pixels.size && pixels.face[p + kAhead] >= 0) {
            prefetch(sums + 2 * kHalvingSums * pixels.face[p + kAhead]);
        }
        const int64_t face = pixels.face[p];
        if (face < 0) continue;
        const float *b = pixels.barycentrics + 3 * p, *lacking = pixels.lacking + 3 * p;
        const int64_t start = longest[face];
        const bool second = b[(start + 1) % 3] > b[start];
        const float counted = pixels.counted[p];
        float* into = sums + (2 * face + second) * kHalvingSums;
        for (int i = 0; i < 3; ++i) {
            for (int j = i; j < 3; ++j) *into++ += counted * (b[i] * b[j]);
        }
        for (int i = 0; i < 3; ++i) {
            for (int c = 0; c < 3; ++c) *into++ += counted * (b[i] * lacking[c]);
        }
    }
}

}  // namespace etsplat
