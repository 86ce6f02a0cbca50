// How far photos agree on what they show at points of a surface, and how far its colours differ from it (src/etsplat/data/agreement.py says what for).
#pragma once

#include <cstdint>
#include <vector>

namespace etsplat {

struct AskedPhoto {
    const float* pixels;   // (4, height, width), of which the first three are compared
    const float* mask;     // (height, width) which pixels count, 0 or 1
    int32_t width, height;
    const float* viewmat;  // (4, 4) world to camera
    const float* K;        // (3, 3)
    const float* center;   // (3,) of the camera
};

struct AgreementRules {
    int32_t patch;   // pixels across the patches that are compared
    int32_t asked;   // at most so many photos are compared at a point: those that look at it most squarely
    float slant;     // cosine of the angle to the normal, up to which a photo is not asked
    float flat;      // standard deviation of colours up to which a patch shows nothing to compare
    float whole;     // share of a patch that must count for more
    int32_t fewest;  // with fewer photos that show something nothing is known
    float pixel;     // how far apart the points of a patch are
};

// result[n] is the mean of the upper half of the correlations between the photos that see point n; NaN if too few do.
// points and normals (N, 3), seen (photos, N).
void photo_agreement(const std::vector<AskedPhoto>& photos, const AgreementRules& rules, const float* points,
                     const float* normals, const bool* seen, int64_t N, float* result);

// For each pixel of a photo (4, size) with an alpha above `opaque` at which a face is seen: 1 is added to the first of the face's
// sums (faces, 1 + shown), and the mean difference of its colour from that of each face that is shown there to the others.
void add_differences(const float* pixels, int64_t size, float opaque, const int64_t* seen,
                     const std::vector<const int64_t*>& shown, const float* colors, float* sums);

}  // namespace etsplat
