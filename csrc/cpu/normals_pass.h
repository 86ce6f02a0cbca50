// The data of one comparison of normals and the interface of its loop, which exists once per instruction set
// (simd/normals.h).
#pragma once

#include <cstdint>

#include "math/depth_normals.h"

namespace etsplat {

constexpr int64_t kNormalRows = 32;  // rows of an image that a thread takes at a time

struct NormalsPass {
    const float *normals, *depth, *alpha;  // (H, W, 3), (H, W), (H, W) of one view
    float *by_normals, *by_depth;          // derivatives of the sum of agreements, or null both
    int64_t height, width;
    DepthView view;
};

struct NormalsKernels {
    // Sum of the agreements of rows first .. last - 1.
    using Band = double (*)(const NormalsPass&, int64_t first, int64_t last, float* scratch);
    Band band;

    static int64_t scratch_size(int64_t width) { return 18 * width; }  // floats
};

}  // namespace etsplat
