// L1 (or squared) difference and SSIM of some rows, with the gradient, in one sweep over the rows.
//
// The 11 x 11 window is separable: a row is blurred along x when it arrives and kept in a ring of 11 rows; the blur along
// y reads the ring. The gradient needs a second blur, of three derivative maps, which follows five rows behind through
// rings of its own. So a sweep touches its rows and ten above and below, and its working set (about 120 KiB per 100 pixels
// of width) stays in the second-level cache. Rows and columns outside the image are zero, as in 3DGS.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstring>
#include <utility>

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

// Similarities and their derivatives from the four moments.
inline void similarity_row(float* const moments[4], float* __restrict similarity, float* __restrict by_mean,
                           float* __restrict by_square, float* __restrict by_product, int64_t n) {
    const float *__restrict mx = moments[0], *__restrict my = moments[1];
    const float *__restrict square = moments[2], *__restrict product = moments[3];
    for (int64_t i = 0; i < n; ++i) {
        const Similarity s = ::etsplat::similarity(mx[i], my[i], square[i], product[i]);
        similarity[i] = s.value;
        by_mean[i] = s.by_mean;
        by_square[i] = s.by_square;
        by_product[i] = s.by_product;
    }
}

template <class Value>
void target_row(const PhotometricPass& pass, const Value* __restrict in, const float* background, float* __restrict y) {
    if (pass.channels == 3) {
        for (int64_t i = 0; i < 3 * pass.width; ++i) y[i] = unit_value(in[i]);
        return;
    }
    float behind[3] = {};
    if (background) std::copy_n(background, 3, behind);
    for (int64_t p = 0; p < pass.width; ++p) {
        const float rest = 1.0f - unit_value(in[4 * p + 3]);
        for (int c = 0; c < 3; ++c) y[3 * p + c] = over_background(unit_value(in[4 * p + c]), rest, behind[c]);
    }
}

// One row of the target over its background, y. `at` is the row's first pixel.
void load_target(const PhotometricPass& pass, int64_t view, int64_t at, float* y) {
    const float* background = pass.backgrounds ? pass.backgrounds + 3 * view : nullptr;
    if (pass.bytes) {
        target_row(pass, static_cast<const uint8_t*>(pass.target) + pass.channels * at, background, y);
    } else {
        target_row(pass, static_cast<const float*>(pass.target) + pass.channels * at, background, y);
    }
}

// One row of what is compared with it, y + mask (color - y).
void load_masked(const PhotometricPass& pass, int64_t at, const float* __restrict y, float* __restrict x) {
    const float* __restrict color = pass.color + 3 * at;
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

// Without SSIM: one row at a time.
void pixel_sweep(const PhotometricPass& pass, int64_t view, int64_t first, int64_t last, float* scratch,
                 PhotometricSums* sums) {
    const int64_t n = 3 * pass.width;
    float *masked = scratch, *y = scratch + n;
    for (int64_t row = first; row < last; ++row) {
        const int64_t at = (view * pass.height + row) * pass.width;
        load_target(pass, view, at, y);
        if (pass.mask) load_masked(pass, at, y, masked);
        float* gradient = pass.gradient ? pass.gradient + 3 * at : nullptr;
        const float* x = pass.mask ? masked : pass.color + 3 * at;
        sums[(row - first) / kBandRows].pixel += pixel_row(pass, x, y, gradient, n);
        if (gradient) mask_row(pass, at, gradient);
    }
}

// The rows that a sweep keeps around the one at hand. Rows of x, y, their products and the maps have zeros on both sides.
struct Rows {
    Rows(float* scratch, int64_t n)
        : memory(scratch), padded(n + 2 * kPad),
          xs(take(kTaps * padded), padded), ys(take(kTaps * padded), padded),
          moments{ring(n), ring(n), ring(n), ring(n)}, maps{ring(n), ring(n), ring(n)},
          square(take(padded) + kPad), product(take(padded) + kPad), similarity(take(n)),
          blurred{take(n), take(n), take(n), take(n)},
          map{take(padded) + kPad, take(padded) + kPad, take(padded) + kPad} {}
    float* take(int64_t count) { return std::exchange(memory, memory + count); }
    Ring ring(int64_t n) { return {take(kTaps * n), n}; }
    float* x(int64_t row) { return xs.row(row) + kPad; }
    float* y(int64_t row) { return ys.row(row) + kPad; }

    float* memory;
    int64_t padded;
    Ring xs, ys, moments[4], maps[3];  // the latter two blurred along x
    float *square, *product, *similarity, *blurred[4], *map[3];
};

// Rows outside the image are zero.
void load_row(const PhotometricPass& pass, int64_t view, int64_t row, float* x, float* y) {
    const int64_t n = 3 * pass.width, at = (view * pass.height + row) * pass.width;
    if (row < 0 || row >= pass.height) {
        std::fill_n(x, n, 0.0f);
        std::fill_n(y, n, 0.0f);
        return;
    }
    load_target(pass, view, at, y);
    if (pass.mask) {
        load_masked(pass, at, y, x);
    } else {
        std::copy_n(pass.color + 3 * at, n, x);
    }
}

void blur_moments(Rows& rows, int64_t row, int64_t n) {
    const float *__restrict x = rows.x(row), *__restrict y = rows.y(row);
    float *__restrict square = rows.square, *__restrict product = rows.product;
    for (int64_t i = 0; i < n; ++i) {
        square[i] = x[i] * x[i] + y[i] * y[i];
        product[i] = x[i] * y[i];
    }
    const float* sources[4] = {x, y, square, product};
    for (int k = 0; k < 4; ++k) blur_row(sources[k], rows.moments[k].row(row), n);
}

// The gradient of the structural part at a row whose maps are there on both sides.
void add_slopes(const PhotometricPass& pass, Rows& rows, int64_t row, int64_t at, int64_t n) {
    for (int k = 0; k < 3; ++k) rows.maps[k].blur(row, rows.blurred[k]);
    float* __restrict gradient = pass.gradient + 3 * at;
    const float *__restrict x = rows.x(row), *__restrict y = rows.y(row);
    const float *by_mean = rows.blurred[0], *by_square = rows.blurred[1], *by_product = rows.blurred[2];
    const float weight = pass.ssim_weight;
    for (int64_t i = 0; i < n; ++i) {
        gradient[i] -= weight * similarity_slope(by_mean[i], by_square[i], by_product[i], x[i], y[i]);
    }
    mask_row(pass, at, gradient);
}

void photometric_sweep(const PhotometricPass& pass, int64_t view, int64_t first, int64_t last, float* scratch,
                       PhotometricSums* sums) {
    if (pass.ssim_weight == 0.0f) return pixel_sweep(pass, view, first, last, scratch, sums);
    const int64_t n = 3 * pass.width, image = view * pass.height;
    std::memset(scratch, 0, static_cast<size_t>(photometric_scratch_size(pass.width)) * sizeof(float));
    Rows rows(scratch, n);
    const int64_t reach = pass.gradient ? 2 * kReach : kReach;
    for (int64_t row = first - reach; row < last + reach; ++row) {
        load_row(pass, view, row, rows.x(row), rows.y(row));
        if (row >= first && row < last) {
            float* gradient = pass.gradient ? pass.gradient + (image + row) * n : nullptr;
            sums[(row - first) / kBandRows].pixel += pixel_row(pass, rows.x(row), rows.y(row), gradient, n);
        }
        blur_moments(rows, row, n);

        const int64_t centre = row - kReach;
        if (centre < first - (reach - kReach)) continue;
        if (centre >= 0 && centre < pass.height) {
            for (int k = 0; k < 4; ++k) rows.moments[k].blur(centre, rows.blurred[k]);
            similarity_row(rows.blurred, rows.similarity, rows.map[0], rows.map[1], rows.map[2], n);
            if (centre >= first && centre < last) {
                double& sum = sums[(centre - first) / kBandRows].ssim;
                sum += lane_sum(n, [similarity = rows.similarity](int64_t i) { return similarity[i]; });
            }
        } else {
            for (float* map : rows.map) std::fill_n(map, n, 0.0f);
        }
        if (!pass.gradient) continue;
        for (int k = 0; k < 3; ++k) blur_row(rows.map[k], rows.maps[k].row(centre), n);

        const int64_t done = centre - kReach;
        if (done >= first) add_slopes(pass, rows, done, (image + done) * pass.width, n);
    }
}

}  // namespace
}  // namespace etsplat::ETSPLAT_SIMD
