// The triangle loops for one instruction set. CMake compiles this file once for each (ETSPLAT_SIMD).
#include "paths.h"

#include "project.h"
#include "reduce.h"

namespace etsplat::ETSPLAT_SIMD {

TriangleKernels triangle_kernels() {
#define ETSPLAT_PROJECT(K) project_chunk<K>,
    return {{ETSPLAT_KERNELS(ETSPLAT_PROJECT)}, number_chunk, reduce_chunk};
#undef ETSPLAT_PROJECT
}

}  // namespace etsplat::ETSPLAT_SIMD
