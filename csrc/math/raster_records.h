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

// For what is interpolated over a triangle: a_k(p) = 1/3 + grad a_k . (p - c), c the mean of the vertices.
struct alignas(64) AttributeRecord {
    float ax[3], ay[3];        // grad a_k
    float inverse_z[3];        // 1 / view depth of the vertices
    float offset_x, offset_y;  // q - c
    float centroid_z;
    float padding[4];
};

enum class DistortionDepth : int { kNone, kPlane, kCentroid };

// Where a slot keeps its sums over pixels. With dx = dL/dx of a pixel at p whose largest form is k:
// moment[k] = sum dx, moment_x/y[k] = sum dx (p - q).
struct SlotLayout {
    static constexpr int kMoment = 0, kMomentX = 3, kMomentY = 6, kOpacity = 9, kSigma = 10, kFlat = 11;
    int flat_channels = 0, corner_channels = 0;
    bool attributes = false, centroid_z = false;

    // the same three moments of dL/d a_k, then dL/d(1/z_k), then the corner colours, corner-major
    ETSPLAT_CONSTEXPR_FN int barycentric() const { return kFlat + flat_channels; }
    ETSPLAT_CONSTEXPR_FN int inverse_z() const { return barycentric() + 9; }
    ETSPLAT_CONSTEXPR_FN int corner() const { return inverse_z() + 3; }
    ETSPLAT_CONSTEXPR_FN int depth() const { return attributes ? corner() + 3 * corner_channels : kFlat + flat_channels; }
    ETSPLAT_CONSTEXPR_FN int size() const { return depth() + (centroid_z ? 1 : 0); }
    ETSPLAT_CONSTEXPR_FN int stride() const { return (size() + 15) / 16 * 16; }
};

}  // namespace etsplat
