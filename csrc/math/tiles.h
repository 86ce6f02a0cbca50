// Which tiles a triangle's visible support {x <= extent} touches: the separating-axis test of the scaled triangle against
// the box of a tile's pixel centres (the tile's own axes by the bounding box, the triangle's by the three forms).
#pragma once

#include "triangle.h"

namespace etsplat {

constexpr int kTile = 16;  // pixels along a side

// The tiles that meet the bounding box: columns left..right and rows top..bottom, as whole floats.
template <class T>
struct TileRange {
    T left, right, top, bottom;
    MaskOf<T> any;  // the box holds a pixel centre of the image

    ETSPLAT_FN TileRange(const SupportBox<T>& box, T qx, T qy, int width, int height) {
        const float w = static_cast<float>(width), h = static_cast<float>(height);
        const T zero(0.0f), half(0.5f);
        const T x0 = ceiling(vmin(vmax(qx + box.left - half, zero), T(w)));
        const T x1 = vfloor(vmin(vmax(qx + box.right - half, T(-1.0f)), T(w - 1.0f)));
        const T y0 = ceiling(vmin(vmax(qy + box.top - half, zero), T(h)));
        const T y1 = vfloor(vmin(vmax(qy + box.bottom - half, T(-1.0f)), T(h - 1.0f)));
        any = (x0 <= x1) & (y0 <= y1);
        const T per_tile(1.0f / kTile);
        left = vfloor(x0 * per_tile);
        right = vfloor(x1 * per_tile);
        top = vfloor(y0 * per_tile);
        bottom = vfloor(y1 * per_tile);
    }

private:
    ETSPLAT_FN static T ceiling(T a) { return T(0.0f) - vfloor(T(0.0f) - a); }
};

template <class T>
struct TileTest {
    DistanceForms<T> forms;
    T slack[3];

    ETSPLAT_FN TileTest(const DistanceForms<T>& f, T extent) : forms(f) {
        const T reach(kReach);
        for (int k = 0; k < 3; ++k)
            slack[k] = extent * T(1.0f + 1e-5f) + T(1e-5f) + reach * (vabs(f.gx[k]) + vabs(f.gy[k]));
    }
    ETSPLAT_FN MaskOf<T> touches(T column, T row) const {
        const T x = column * T(float(kTile)) + T(0.5f + kReach) - forms.qx;
        const T y = row * T(float(kTile)) + T(0.5f + kReach) - forms.qy;
        return (forms.gx[0] * x + forms.gy[0] * y <= slack[0]) & (forms.gx[1] * x + forms.gy[1] * y <= slack[1]) &
               (forms.gx[2] * x + forms.gy[2] * y <= slack[2]);
    }

private:
    static constexpr float kReach = 0.5f * (kTile - 1);
};

}  // namespace etsplat
