#pragma once

#include "cpu/photometric_pass.h"

namespace etsplat {
namespace plain {
PhotometricKernels photometric_kernels();
}
namespace avx2 {
PhotometricKernels photometric_kernels();
}
namespace avx512 {
PhotometricKernels photometric_kernels();
}
namespace neon {
PhotometricKernels photometric_kernels();
}
}  // namespace etsplat
