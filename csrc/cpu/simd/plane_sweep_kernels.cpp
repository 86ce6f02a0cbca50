// The loops of a sweep of planes for one instruction set. CMake compiles this file once for each (ETSPLAT_SIMD).
#include "paths.h"

#include "plane_sweep.h"

namespace etsplat::ETSPLAT_SIMD {

PlaneSweepKernels plane_sweep_kernels() { return {plane_sweep_judge, plane_sweep_choose}; }

}  // namespace etsplat::ETSPLAT_SIMD
