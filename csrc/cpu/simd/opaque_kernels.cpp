// The z-buffer's loops for one instruction set. CMake compiles this file once for each (ETSPLAT_SIMD).
#include "paths.h"

#include "opaque.h"

namespace etsplat::ETSPLAT_SIMD {

OpaqueKernels opaque_kernels() { return {draw_opaque}; }

}  // namespace etsplat::ETSPLAT_SIMD
