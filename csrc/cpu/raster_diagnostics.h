// Counters and a yardstick for benchmarks/rasterizer.py.
#pragma once

#include <string>
#include <vector>

#include "raster.h"

namespace etsplat {

// What the tile loops do for this render, counted by going through its tiles once more. The inputs of the render must
// still be in memory.
TileCounts count_tiles(const RasterState& state);

// The structs of math/kernels.h, in the order in which calls number them.
std::vector<std::string> kernel_names();

struct KernelNanoseconds {
    double value, gradient;
};

// Nanoseconds that a tight loop over an array in the first-level cache needs for 16 values of a kernel, and for 16 values
// with both derivatives, on one thread and the active instruction set; the best of many runs. Not of the last kernel, which wants a table.
KernelNanoseconds time_kernel(int kernel, float sigma);

}  // namespace etsplat
