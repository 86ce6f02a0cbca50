#pragma once

#include "cpu/normals_pass.h"

namespace etsplat {
namespace plain {
NormalsKernels normals_kernels();
}
namespace avx2 {
NormalsKernels normals_kernels();
}
namespace avx512 {
NormalsKernels normals_kernels();
}
namespace neon {
NormalsKernels normals_kernels();
}
}  // namespace etsplat
