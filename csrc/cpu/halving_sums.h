// Of the halves of triangles, what src/etsplat/optim/halving_gains.py asks pictures for.
#pragma once

#include <cstdint>

namespace etsplat {

constexpr int32_t kHalvingSums = 15;  // six products of barycentrics, nine of these and what a pixel lacks

// The pixels of a picture.
struct HalvingPixels {
    const int64_t* face;        // the nearest, -1: none
    const float* barycentrics;  // 3 of each pixel's middle
    const float* lacking;       // 3 channels
    const float* counted;       // how much a pixel counts
    int64_t size;
};

// Adds them to the sums (faces, 2, kHalvingSums) of the halves that they lie in. longest (faces,): the edge, from that corner on,
// at whose middle a face is halved.
void add_halving_sums(const HalvingPixels& pixels, const int64_t* longest, float* sums);

// By how much the sum of squared differences of each part of the photos is less for the halves of a face, added up, where both
// halves and whole are corrected by all other parts: sums (parts, faces, 2, kHalvingSums), gains (faces). 0 where fewer than
// two parts show a face: what a single one shows, nobody else says anything of.
void halving_gains(const float* sums, int64_t parts, int64_t faces, double* gains);

}  // namespace etsplat
