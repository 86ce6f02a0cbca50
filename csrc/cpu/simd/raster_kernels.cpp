// The tile loops for one instruction set. CMake compiles this file once for each (ETSPLAT_SIMD).
#include "paths.h"

#include "diagnostics.h"
#include "tile_backward.h"
#include "tile_forward.h"

namespace etsplat::ETSPLAT_SIMD {

RasterKernels raster_kernels() {
#define ETSPLAT_FORWARD(K) {forward_tile<K, Shape::kFlat>, forward_tile<K, Shape::kCorner>, forward_tile<K, Shape::kGeneral>},
#define ETSPLAT_BACKWARD(K) {backward_tile<K, Shape::kFlat>, backward_tile<K, Shape::kCorner>, backward_tile<K, Shape::kGeneral>},
#define ETSPLAT_COUNT(K) count_tile<K>,
#define ETSPLAT_VALUE(K) value_loop<K>,
#define ETSPLAT_GRADIENT(K) gradient_loop<K>,
    return {{ETSPLAT_KERNELS(ETSPLAT_FORWARD)},
            {ETSPLAT_KERNELS(ETSPLAT_BACKWARD)},
            {ETSPLAT_KERNELS(ETSPLAT_COUNT)},
            {ETSPLAT_KERNELS(ETSPLAT_VALUE)},
            {ETSPLAT_KERNELS(ETSPLAT_GRADIENT)}};
#undef ETSPLAT_FORWARD
#undef ETSPLAT_BACKWARD
#undef ETSPLAT_COUNT
#undef ETSPLAT_VALUE
#undef ETSPLAT_GRADIENT
}

}  // namespace etsplat::ETSPLAT_SIMD
