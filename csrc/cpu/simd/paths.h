// What the files *_kernels.cpp define, each compiled once for every instruction set.
#pragma once

#include "cpu/colors_pass.h"
#include "cpu/normals_pass.h"
#include "cpu/opaque_pass.h"
#include "cpu/photometric_pass.h"
#include "cpu/plane_sweep_pass.h"
#include "cpu/raster_pass.h"
#include "cpu/triangle_pass.h"

namespace etsplat {

#define ETSPLAT_DECLARE_PATH(name)            \
    namespace name {                          \
    RasterKernels raster_kernels();           \
    TriangleKernels triangle_kernels();       \
    PhotometricKernels photometric_kernels(); \
    ColorsKernels colors_kernels();           \
    NormalsKernels normals_kernels();         \
    OpaqueKernels opaque_kernels();           \
    PlaneSweepKernels plane_sweep_kernels();  \
    }
ETSPLAT_DECLARE_PATH(plain)
ETSPLAT_DECLARE_PATH(avx2)
ETSPLAT_DECLARE_PATH(avx512)
ETSPLAT_DECLARE_PATH(neon)
#undef ETSPLAT_DECLARE_PATH

}  // namespace etsplat
