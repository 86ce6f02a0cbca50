// What a triangle is to the tile loops of both engines, and where a triangle's sums over pixels are kept.
#pragma once

#include "portable.h"

namespace etsplat {

// One cache line.
struct alignas(64) TriangleRecord {
    float qx, qy;                    // the point where x = 0: mean of the vertices, or incentre
    float gx[3], gy[3];              // x(p) = max_k g_k . (p - q)
    float extent;                    // largest visible x
    float opacity;
    float exponent, scale;           // KernelCoefficients
    float left, right, top, bottom;  // bounding box of {x <= extent}, relative to q
};

// For what is interpolated over a triangle. With f_k = g_k . (p - q), a barycentric is a_k = (1 - f_k) / w_k.
struct alignas(32) AttributeRecord {
    float inverse_weight[3];  // 1 / w_k
    float product[3];         // 1 / (w_k z_k), z_k the view depth of the vertex
    float centroid_z;
    float padding;
};

constexpr int kMostGpuChannels = 16;  // of a pass on a GPU, whose tile loops keep them in registers

enum class DistortionDepth : int { kNone, kPlane, kCentroid };

// Where a slot keeps its sums over pixels. With df_k = dL/df_k of a pixel at p: moment[k] = sum df_k,
// moment_x/y[k] = sum df_k (p - q).
struct SlotLayout {
    static constexpr int kMoment = 0, kMomentX = 3, kMomentY = 6, kOpacity = 9, kSigma = 10, kFlat = 11;
    int flat_channels = 0, corner_channels = 0;
    DistortionDepth depth = DistortionDepth::kNone;

    // Whether anything is interpolated: corner colours, or the distortion's depth of each pixel.
    ETSPLAT_CONSTEXPR_FN bool attributes() const { return corner_channels > 0 || depth == DistortionDepth::kPlane; }
    // dL/d log(w_k z_k), then the corner colours, corner-major
    ETSPLAT_CONSTEXPR_FN int product() const { return kFlat + flat_channels; }
    ETSPLAT_CONSTEXPR_FN int corner() const { return product() + 3; }
    // kPlane: dL/d log w_k; kCentroid: dL/dz of the centroid
    ETSPLAT_CONSTEXPR_FN int plane() const { return attributes() ? corner() + 3 * corner_channels : product(); }
    ETSPLAT_CONSTEXPR_FN int centroid() const { return plane(); }
    ETSPLAT_CONSTEXPR_FN int size() const {
        return plane() + (depth == DistortionDepth::kPlane ? 3 : depth == DistortionDepth::kCentroid ? 1 : 0);
    }
    ETSPLAT_CONSTEXPR_FN int stride() const { return (size() + 15) / 16 * 16; }
};

}  // namespace etsplat
