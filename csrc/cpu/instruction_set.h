// Which compiled path of the tile, triangle and image loops runs: the widest that this processor has, unless told otherwise.
#pragma once

#include <string>
#include <vector>

#include "colors_pass.h"
#include "normals_pass.h"
#include "opaque_pass.h"
#include "photometric_pass.h"
#include "plane_sweep_pass.h"
#include "raster_pass.h"
#include "triangle_pass.h"

namespace etsplat {

std::vector<std::string> available_instruction_sets();  // widest first
std::string instruction_set();
void set_instruction_set(const std::string& name);  // "" for the widest; throws std::invalid_argument

const RasterKernels& active_raster_kernels();
const TriangleKernels& active_triangle_kernels();
const PhotometricKernels& active_photometric_kernels();
const NormalsKernels& active_normals_kernels();
const OpaqueKernels& active_opaque_kernels();
const ColorsKernels& active_colors_kernels();
const PlaneSweepKernels& active_plane_sweep_kernels();

}  // namespace etsplat
