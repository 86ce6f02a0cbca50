// Sizes that Python needs to know, from the headers that say them to both engines.
#include "bindings.h"
#include "math/raster_records.h"
#include "math/spherical_harmonics.h"
#include "math/tiles.h"
#include "math/triangle.h"
#include "rasterize_opaque.h"

namespace etsplat {

void bind_constants(nb::module_& m) {
    m.attr("TILE") = kTile;
    m.attr("TRIANGLE_RECORD") = sizeof(TriangleRecord) / sizeof(float);
    m.attr("ATTRIBUTE_RECORD") = sizeof(AttributeRecord) / sizeof(float);
    m.attr("CAMERA_GRADIENTS") = kCameraGradients;
    m.attr("MOST_GPU_CHANNELS") = kMostGpuChannels;
    m.attr("MAX_SH_DEGREE") = kMaxShDegree;
    m.attr("OPAQUE_PARTS") = kOpaqueParts;
    nb::enum_<DistortionDepth>(m, "DistortionDepth", nb::is_arithmetic())
        .value("NONE", DistortionDepth::kNone)
        .value("PLANE", DistortionDepth::kPlane)
        .value("CENTROID", DistortionDepth::kCentroid);
    // Floats of a slot of the rasterizer's backward pass.
    def_function(
        m, "slot_stride",
        [](int flat_channels, int corner_channels, DistortionDepth distortion) {
            return SlotLayout{flat_channels, corner_channels, distortion}.stride();
        },
        "flat_channels", "corner_channels", "distortion");
}

}  // namespace etsplat
