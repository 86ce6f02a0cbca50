// What the z-buffer's loops (simd/opaque_kernels.cpp) read and write: the triangles of one tile of samples.
#pragma once

#include <cstdint>

#include "math/opaque_triangle.h"

namespace etsplat {

struct OpaqueTile {
    int32_t x0, y0, x1, y1;  // samples of the tile, clipped to the screen
    int32_t width;           // of the screen
    int32_t stride;
    float* inverse_depth;  // (stride, stride), and so many more as are drawn at a time
    int32_t* triangle;
};

constexpr int kMostAtATime = 16;  // samples of a row

struct OpaqueKernels {
    // Draws triangles[indices[0 .. count - 1]]; these ascend.
    using Draw = void (*)(const OpaqueTriangle* triangles, const int32_t* indices, int64_t count, const OpaqueTile&);
    Draw draw;
};

}  // namespace etsplat
