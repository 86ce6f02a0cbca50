// The photometric loops for one instruction set. CMake compiles this file once for each (ETSPLAT_SIMD).
#include "paths.h"

#include "photometric.h"

namespace etsplat::ETSPLAT_SIMD {

PhotometricKernels photometric_kernels() { return {photometric_sweep}; }

}  // namespace etsplat::ETSPLAT_SIMD
