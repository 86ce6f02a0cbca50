#pragma once

#include "cpu/raster_pass.h"

namespace etsplat {
namespace plain {
RasterKernels raster_kernels();
}
namespace avx2 {
RasterKernels raster_kernels();
}
namespace avx512 {
RasterKernels raster_kernels();
}
namespace neon {
RasterKernels raster_kernels();
}
}  // namespace etsplat
