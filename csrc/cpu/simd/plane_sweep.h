// How well the window around each pixel of a photo matches what its neighbours would show there if all lay on one plane.
//
// A plane is judged in one sweep over rows: what a neighbour shows of a row is looked up and summed along x when the row
// arrives, and kept until the windows of the rows around it have been correlated. So the working set is some rows of each
// neighbour, whatever the size of the photo. Windows end where the photo does.
#pragma once

#include <string.h>

#include "cpu/plane_sweep_pass.h"
#include "pack.h"

namespace etsplat::ETSPLAT_SIMD {
namespace {

static_assert(kSweepLanes == kLanes);

ETSPLAT_FN Vec lanes_from(int64_t first) {
    float lanes[kLanes];
    for (int i = 0; i < kLanes; ++i) lanes[i] = static_cast<float>(first + i);
    return Vec::load(lanes);
}

// What a neighbour shows of a row of the photo on a plane, and whether it shows that.
void show_row(const PlaneSweep& sweep, const SweptNeighbour& there, float inverse, int64_t y, float* shows, float* shown) {
    const float* m = there.rays;
    const float row = static_cast<float>(y) + 0.5f;
    float at[3];
    for (int i = 0; i < 3; ++i) at[i] = m[3 * i + 1] * row + m[3 * i + 2] + there.start[i] * inverse;
    const auto width = static_cast<float>(there.width), height = static_cast<float>(there.height);
    const Vec zero(0.0f), half(0.5f), one(1.0f), wide(width), high(height), end(static_cast<float>(sweep.width));
    for (int64_t x = 0; x < sweep.stride; x += kLanes) {
        const Vec number = lanes_from(x), column = number + half;
        const Vec depth = vfma(Vec(m[6]), column, Vec(at[2])), over = one / vmax(depth, Vec(sweep.least_depth));
        const Vec right = vfma(Vec(m[0]), column, Vec(at[0])) * over, below = vfma(Vec(m[3]), column, Vec(at[1])) * over;
        const VecMask inside = (right > zero) & (right < wide) & (below > zero) & (below < high) & (depth > zero);
        const Vec u = vmin(vmax(right + half, zero), wide + one), v = vmin(vmax(below + half, zero), high + one);
        const Vec left = vfloor(u), top = vfloor(v);
        Vec corners[4];
        vlookup4(there.quads, Vec(4.0f) * vfma(top, wide + Vec(2.0f), left), corners);
        const Vec part = u - left;
        const Vec above = vfma(part, corners[1] - corners[0], corners[0]);
        const Vec under = vfma(part, corners[3] - corners[2], corners[2]);
        keep(number < end, vfma(v - top, under - above, above)).store(shows + x);
        vselect(inside, one, zero).store(shown + x);
    }
}

// Sums along x of the window around each pixel of a row that has zeros on both sides.
ETSPLAT_FN void sum_along(const float* row, int64_t reach, int64_t stride, float* sums) {
    for (int64_t x = 0; x < stride; x += kLanes) {
        Vec sum = Vec::load(row + x - reach);
        for (int64_t step = 1 - reach; step <= reach; ++step) sum = sum + Vec::load(row + x + step);
        sum.store(sums + x);
    }
}

// The rows of `plane_sweep_scratch`.
struct SweptRing {
    float* kept;
    int64_t stride, taps;

    float* of(int64_t neighbour, int64_t y) const { return kept + (neighbour * taps + y % taps) * kSweptRows * stride; }
    float* single(int64_t neighbours, int64_t number) const {
        return of(neighbours, 0) + number * (stride + 2 * kLanes) + kLanes;
    }
};

// The sum of a window: of the rows y - reach .. y + reach that are in the photo, in order.
ETSPLAT_FN Vec sum_down(const SweptRing& ring, int64_t neighbour, int64_t first, int64_t last, int64_t offset) {
    Vec sum = Vec::load(ring.of(neighbour, first) + offset);
    for (int64_t y = first + 1; y <= last; ++y) sum = sum + Vec::load(ring.of(neighbour, y) + offset);
    return sum;
}

void correlate_row(const PlaneSweep& sweep, const SweptRing& ring, int64_t y, float* judged) {
    const int64_t first = y < sweep.reach ? 0 : y - sweep.reach;
    const int64_t last = y + sweep.reach < sweep.height ? y + sweep.reach : sweep.height - 1;
    const auto neighbours = static_cast<int64_t>(sweep.neighbours.size());
    for (int64_t x = 0; x < sweep.stride; x += kLanes) {
        const int64_t at = y * sweep.stride + x;
        const Vec over = Vec::load(sweep.across + x) * Vec(sweep.down[y]);
        const Vec here = Vec::load(sweep.mean + at), varies = Vec::load(sweep.variance + at);
        float correlations[kMostSwept][kLanes];
        for (int64_t k = 0; k < neighbours; ++k) {
            Vec means[kSweptSums];
            for (int64_t q = 0; q < kSweptSums; ++q) means[q] = over * sum_down(ring, k, first, last, q * sweep.stride + x);
            const Vec variance = vmax(means[1] - means[0] * means[0], Vec(sweep.least_variance));
            const Vec correlation = (means[2] - here * means[0]) / vsqrt(varies * variance);
            const Vec shown = Vec::load(ring.of(k, y) + kSweptSums * sweep.stride + x);
            Vec lower = vselect(shown > Vec(0.0f), correlation, Vec(-1.0f));
            for (int64_t rank = 0; rank < k; ++rank) {  // in order, the highest first
                const Vec other = Vec::load(correlations[rank]);
                vmax(other, lower).store(correlations[rank]);
                lower = vmin(other, lower);
            }
            lower.store(correlations[k]);
        }
        Vec sum(0.0f);
        for (int64_t rank = 0; rank < sweep.agreeing; ++rank) sum = sum + Vec::load(correlations[rank]);
        (sum / Vec(static_cast<float>(sweep.agreeing))).store(judged + x);
    }
}

void plane_sweep_judge(const PlaneSweep& sweep, int64_t plane, float* scratch) {
    const auto neighbours = static_cast<int64_t>(sweep.neighbours.size());
    const SweptRing ring{scratch, sweep.stride, 2 * sweep.reach + 1};
    float* rows[kSweptSums];
    for (int64_t q = 0; q < kSweptSums; ++q) {
        rows[q] = ring.single(neighbours, q);
        memset(rows[q] - kLanes, 0, static_cast<size_t>(sweep.stride + 2 * kLanes) * sizeof(float));
    }
    for (int64_t arrived = 0; arrived < sweep.height + sweep.reach; ++arrived) {
        for (int64_t k = 0; arrived < sweep.height && k < neighbours; ++k) {
            float* kept = ring.of(k, arrived);
            show_row(sweep, sweep.neighbours[static_cast<size_t>(k)], sweep.inverse[plane], arrived, rows[0],
                     kept + kSweptSums * sweep.stride);
            for (int64_t x = 0; x < sweep.stride; x += kLanes) {
                const Vec shows = Vec::load(rows[0] + x);
                (shows * shows).store(rows[1] + x);
                (shows * Vec::load(sweep.grey + arrived * sweep.stride + x)).store(rows[2] + x);
            }
            for (int64_t q = 0; q < kSweptSums; ++q) sum_along(rows[q], sweep.reach, sweep.stride, kept + q * sweep.stride);
        }
        const int64_t y = arrived - sweep.reach;
        if (y >= 0) correlate_row(sweep, ring, y, sweep.judged + (y * sweep.planes + plane) * sweep.stride);
    }
}

void plane_sweep_choose(const PlaneSweep& sweep, int64_t row, const SweptPlanes& out) {
    const float* judged = sweep.judged + row * sweep.planes * sweep.stride;
    const Vec beside(static_cast<float>(sweep.beside));
    for (int64_t x = 0; x < sweep.width; x += kLanes) {
        Vec best = Vec::load(judged + x), chosen(0.0f), elsewhere(-1.0f);
        for (int64_t plane = 1; plane < sweep.planes; ++plane) {
            const Vec value = Vec::load(judged + plane * sweep.stride + x);
            chosen = vselect(value > best, Vec(static_cast<float>(plane)), chosen);
            best = vmax(best, value);
        }
        for (int64_t plane = 0; plane < sweep.planes; ++plane) {
            const Vec value = Vec::load(judged + plane * sweep.stride + x);
            const VecMask apart = vabs(Vec(static_cast<float>(plane)) - chosen) > beside;
            elsewhere = vselect(apart, vmax(elsewhere, value), elsewhere);
        }
        float numbers[kLanes], bests[kLanes], others[kLanes];
        chosen.store(numbers);
        best.store(bests);
        elsewhere.store(others);
        for (int64_t lane = 0; lane < kLanes && x + lane < sweep.width; ++lane) {
            const int64_t at = row * sweep.width + x + lane, plane = static_cast<int64_t>(numbers[lane]);
            out.best[at] = bests[lane];
            out.elsewhere[at] = others[lane];
            out.place[at] = -1.0f;
            if (plane == 0 || plane + 1 == sweep.planes) continue;
            const float* around = judged + plane * sweep.stride + x + lane;
            const float before = around[-sweep.stride], after = around[sweep.stride];
            const float curve = etsplat::vmin(2.0f * (before - 2.0f * around[0] + after), -1e-6f);
            const float between = etsplat::vmin(etsplat::vmax((before - after) / curve, -0.5f), 0.5f);
            out.place[at] = numbers[lane] + between;
        }
    }
}

}  // namespace
}  // namespace etsplat::ETSPLAT_SIMD
