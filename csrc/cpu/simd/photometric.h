// L1 (or squared) difference and SSIM of a band of rows, with the gradient, in one sweep over the rows.
//
// The 11 x 11 window is separable: a row is blurred along x when it arrives and kept in a ring of 11 rows; the blur along
// y reads the ring. The gradient needs a second blur, of three derivative maps, which follows five rows behind through
// rings of its own. So a band touches its rows and ten above and below, and its working set (about 120 KiB per 100 pixels
// of width) stays in the second-level cache. Rows and columns outside the image are zero, as in 3DGS.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstring>

#include "cpu/photometric_pass.h"
#include "math/photometric.h"
#include "math/ssim.h"

namespace etsplat::ETSPLAT_SIMD {
namespace {

constexpr int kReach = kSsimReach, kTaps = kSsimTaps, kPad = 3 * kReach;

inline void blur_row(const float* __restrict in, float* __restrict out, int64_t n) {
    for (int64_t i = 0; i < n; ++i) {
        out[i] = ssim_blur([=](int k) { return in[i + 3 * k]; });
    }
}

// Rows y - 5 .. y + 5 of one quantity, each blurred along x, blurred along y.
class Ring {
public:
    Ring(float* storage, int64_t n) : storage_(storage), n_(n) {}
    float* row(int64_t y) { return storage_ + ((y % kTaps + kTaps) % kTaps) * n_; }
    void blur(int64_t y, float* __restrict out) {
        const float* __restrict r[kTaps];
        for (int k = 0; k < kTaps; ++k) r[k] = row(y + k - kReach);
        for (int64_t i = 0; i < n_; ++i) {
            out[i] = ssim_blur([&r, i](int k) { return r[kReach + k][i]; });
        }
    }

private:
    float* storage_;
    int64_t n_;
};

struct Moments {
    const float *x, *y, *square, *product;
};

inline void similarity_row(const Moments& m, float* __restrict similarity, float* __restrict by_mean,
                           float* __restrict by_square, float* __restrict by_product, int64_t n) {
    const float *__restrict mx_row = m.x, *__restrict my_row = m.y;
    const float *__restrict square_row = m.square, *__restrict product_row = m.product;
    for (int64_t i = 0; i < n; ++i) {
        const Similarity s = ::etsplat::similarity(mx_row[i], my_row[i], square_row[i], product_row[i]);
        similarity[i] = s.value;
        by_mean[i] = s.by_mean;
        by_square[i] = s.by_square;
        by_product[i] = s.by_product;
    }
}

// One row of the target over its background: y.
template <class Value>
void target_row(const PhotometricPass& pass, const Value* __restrict in, const float* background, float* __restrict y) {
    if (pass.channels == 3) {
        for (int64_t i = 0; i < 3 * pass.width; ++i) y[i] = unit_value(in[i]);
        return;
    }
    for (int64_t p = 0; p < pass.width; ++p) {
        const float rest = 1.0f - unit_value(in[4 * p + 3]);
        for (int c = 0; c < 3; ++c) {
            y[3 * p + c] = over_background(unit_value(in[4 * p + c]), rest, background ? background[c] : 0.0f);
        }
    }
}

// One row of what is compared: y as above, and x = y + mask (color - y).
void load_row(const PhotometricPass& pass, int64_t view, int64_t row, float* __restrict x, float* __restrict y) {
    const int64_t n = 3 * pass.width;
    if (row < 0 || row >= pass.height) {
        std::memset(x, 0, static_cast<size_t>(n) * sizeof(float));
        std::memset(y, 0, static_cast<size_t>(n) * sizeof(float));
        return;
    }
    const int64_t at = (view * pass.height + row) * pass.width;
    const float* background = pass.backgrounds ? pass.backgrounds + 3 * view : nullptr;
    if (pass.bytes) {
        target_row(pass, static_cast<const uint8_t*>(pass.target) + pass.channels * at, background, y);
    } else {
        target_row(pass, static_cast<const float*>(pass.target) + pass.channels * at, background, y);
    }
    const float* __restrict color = pass.color + 3 * at;
    if (!pass.mask) {
        for (int64_t i = 0; i < n; ++i) x[i] = color[i];
        return;
    }
    for (int64_t p = 0; p < pass.width; ++p) {
        for (int64_t i = 3 * p; i < 3 * p + 3; ++i) x[i] = y[i] + pass.mask[at + p] * (color[i] - y[i]);
    }
}

// Sums in lanes that the compiler can keep in vectors without changing the order of a sum.
constexpr int kSumLanes = 16;

template <class F>
inline double lane_sum(int64_t n, F&& value) {
    float lanes[kSumLanes] = {};
    const int64_t whole = n / kSumLanes * kSumLanes;
    for (int64_t i = 0; i < whole; i += kSumLanes)
        for (int lane = 0; lane < kSumLanes; ++lane) lanes[lane] += value(i + lane);
    for (int64_t i = whole; i < n; ++i) lanes[i - whole] += value(i);
    double sum = 0.0;
    for (const float lane : lanes) sum += lane;
    return sum;
}

double pixel_row(const PhotometricPass& pass, const float* __restrict x, const float* __restrict y,
                 float* __restrict gradient, int64_t n) {
    const float weight = pass.pixel_weight;
    if (gradient && pass.squared) {
        for (int64_t i = 0; i < n; ++i) gradient[i] = 2.0f * weight * (x[i] - y[i]);
    } else if (gradient) {
        for (int64_t i = 0; i < n; ++i) gradient[i] = l1_gradient(x[i] - y[i], weight);
    }
    if (pass.squared) return lane_sum(n, [&](int64_t i) { return (x[i] - y[i]) * (x[i] - y[i]); });
    return lane_sum(n, [&](int64_t i) { return std::fabs(x[i] - y[i]); });
}

// The chain rule through the mask, at the end.
void mask_row(const PhotometricPass& pass, int64_t at, float* gradient) {
    if (!pass.mask) return;
    for (int64_t p = 0; p < pass.width; ++p)
        for (int c = 0; c < 3; ++c) gradient[3 * p + c] *= pass.mask[at + p];
}

PhotometricSums photometric_band(const PhotometricPass& pass, int64_t view, int64_t first, int64_t last,
                                 float* scratch) {
    const int64_t n = 3 * pass.width, padded = n + 2 * kPad;
    std::memset(scratch, 0, static_cast<size_t>(photometric_scratch_size(pass.width)) * sizeof(float));
    const auto take = [&scratch](int64_t count) {
        float* taken = scratch;
        scratch += count;
        return taken;
    };
    Ring xs(take(kTaps * padded), padded), ys(take(kTaps * padded), padded);  // as loaded, with zeros on both sides
    Ring moments[4] = {{take(kTaps * n), n}, {take(kTaps * n), n}, {take(kTaps * n), n}, {take(kTaps * n), n}};
    Ring maps[3] = {{take(kTaps * n), n}, {take(kTaps * n), n}, {take(kTaps * n), n}};
    float *square = take(padded) + kPad, *product = take(padded) + kPad, *similarity = take(n);
    float *blurred[4] = {take(n), take(n), take(n), take(n)}, *map[3];
    for (float*& row : map) row = take(padded) + kPad;

    PhotometricSums sums{0.0, 0.0};
    const bool structural = pass.ssim_weight != 0.0f;
    const int64_t reach = !structural ? 0 : pass.gradient ? 2 * kReach : kReach;
    for (int64_t row = first - reach; row < last + reach; ++row) {
        float *x = xs.row(row) + kPad, *y = ys.row(row) + kPad;
        load_row(pass, view, row, x, y);
        if (row >= first && row < last) {
            float* gradient = pass.gradient ? pass.gradient + (view * pass.height + row) * n : nullptr;
            sums.pixel += pixel_row(pass, x, y, gradient, n);
            if (!structural && gradient) mask_row(pass, (view * pass.height + row) * pass.width, gradient);
        }
        if (!structural) continue;
        for (int64_t i = 0; i < n; ++i) {
            square[i] = x[i] * x[i] + y[i] * y[i];
            product[i] = x[i] * y[i];
        }
        const float* sources[4] = {x, y, square, product};
        for (int k = 0; k < 4; ++k) blur_row(sources[k], moments[k].row(row), n);

        const int64_t centre = row - kReach;
        if (centre < first - (reach - kReach)) continue;
        const bool inside = centre >= 0 && centre < pass.height;
        if (inside) {
            for (int k = 0; k < 4; ++k) moments[k].blur(centre, blurred[k]);
            similarity_row({blurred[0], blurred[1], blurred[2], blurred[3]}, similarity, map[0], map[1], map[2], n);
            if (centre >= first && centre < last) {
                sums.ssim += lane_sum(n, [similarity](int64_t i) { return similarity[i]; });
            }
        } else {
            for (float* m : map) std::memset(m, 0, static_cast<size_t>(n) * sizeof(float));
        }
        if (!pass.gradient) continue;
        for (int k = 0; k < 3; ++k) blur_row(map[k], maps[k].row(centre), n);

        const int64_t done = centre - kReach;
        if (done < first) continue;
        for (int k = 0; k < 3; ++k) maps[k].blur(done, blurred[k]);
        float* __restrict gradient = pass.gradient + (view * pass.height + done) * n;
        const float *__restrict x_done = xs.row(done) + kPad, *__restrict y_done = ys.row(done) + kPad;
        for (int64_t i = 0; i < n; ++i) {
            gradient[i] -= pass.ssim_weight *
                           similarity_slope(blurred[0][i], blurred[1][i], blurred[2][i], x_done[i], y_done[i]);
        }
        mask_row(pass, (view * pass.height + done) * pass.width, gradient);
    }
    return sums;
}

}  // namespace
}  // namespace etsplat::ETSPLAT_SIMD
