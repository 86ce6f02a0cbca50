// Which tiles a triangle's visible support touches: the separating-axis test of the scaled triangle against the box of
// the tile's pixel centres (its own axes by the bounding box, the triangle's by the three forms).
#pragma once

#include <algorithm>
#include <cmath>

#include "raster_pass.h"

namespace etsplat {

template <class F>
void for_each_tile(const TriangleRecord& r, const RasterPass& pass, F&& body) {
    // range of pixel centres, clamped as floats before they become integers
    const float w = static_cast<float>(pass.width), h = static_cast<float>(pass.height);
    const int x0 = static_cast<int>(std::ceil(std::clamp(r.qx + r.left - 0.5f, 0.0f, w)));
    const int x1 = static_cast<int>(std::floor(std::clamp(r.qx + r.right - 0.5f, -1.0f, w - 1.0f)));
    const int y0 = static_cast<int>(std::ceil(std::clamp(r.qy + r.top - 0.5f, 0.0f, h)));
    const int y1 = static_cast<int>(std::floor(std::clamp(r.qy + r.bottom - 0.5f, -1.0f, h - 1.0f)));
    if (x0 > x1 || y0 > y1) return;
    const int left = x0 / kTile, right = x1 / kTile, top = y0 / kTile, bottom = y1 / kTile;
    constexpr float kReach = 0.5f * (kTile - 1);
    float slack[3];
    for (int k = 0; k < 3; ++k)
        slack[k] = r.extent * (1.0f + 1e-5f) + 1e-5f + kReach * (std::abs(r.gx[k]) + std::abs(r.gy[k]));
    for (int ty = top; ty <= bottom; ++ty) {
        const float y = static_cast<float>(ty * kTile) + 0.5f + kReach - r.qy;
        for (int tx = left; tx <= right; ++tx) {
            const float x = static_cast<float>(tx * kTile) + 0.5f + kReach - r.qx;
            const bool apart = r.gx[0] * x + r.gy[0] * y > slack[0] || r.gx[1] * x + r.gy[1] * y > slack[1] ||
                               r.gx[2] * x + r.gy[2] * y > slack[2];
            if (!apart) body(ty * pass.tiles_x + tx);
        }
    }
}

}  // namespace etsplat
