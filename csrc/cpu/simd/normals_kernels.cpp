// The comparison of normals for one instruction set. CMake compiles this file once for each (ETSPLAT_SIMD).
#include "paths.h"

#include "normals.h"

namespace etsplat::ETSPLAT_SIMD {

NormalsKernels normals_kernels() { return {normals_band}; }

}  // namespace etsplat::ETSPLAT_SIMD
