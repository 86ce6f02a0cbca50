// The colours of separate triangles for one instruction set. CMake compiles this file once for each (ETSPLAT_SIMD).
#include "paths.h"

#include "colors.h"

namespace etsplat::ETSPLAT_SIMD {

ColorsKernels colors_kernels() { return {colors_forward, colors_backward}; }

}  // namespace etsplat::ETSPLAT_SIMD
