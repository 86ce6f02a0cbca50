#pragma once

#include "cpu/triangle_pass.h"

namespace etsplat {
namespace plain {
TriangleKernels triangle_kernels();
}
namespace avx2 {
TriangleKernels triangle_kernels();
}
namespace avx512 {
TriangleKernels triangle_kernels();
}
namespace neon {
TriangleKernels triangle_kernels();
}
}  // namespace etsplat
