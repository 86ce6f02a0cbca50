// Opaque triangles on a grid of samples: projection, set-up, coverage and depth, in double.
//
// Coverage is the top-left rule by scan conversion. On the row of samples at height y, the edge from its upper end a to
// its lower end b crosses at x = a.x + (y - a.y) slope; it is active for a.y <= y < b.y, and a sample lies right of it
// if sample.x >= x. A triangle fills between the two edges active on a row. Neighbours compute the same number for
// their common edge, so that their spans meet without crack, whatever the rounding.
#pragma once

#include "portable.h"

namespace etsplat {

struct OpaqueVertex {
    double x, y, inverse_depth;  // in samples; inverse_depth is NaN where the vertex cannot be drawn
};

ETSPLAT_FN bool is_finite(double a) { return a - a == 0.0; }

ETSPLAT_FN OpaqueVertex project_opaque(const float* viewmat, const float* K, float near_plane, int samples,
                                   const float* point) {
    double c[3];
    for (int r = 0; r < 3; ++r) {
        const float* m = viewmat + 4 * r;
        c[r] = static_cast<double>(m[0]) * point[0] + static_cast<double>(m[1]) * point[1] +
               static_cast<double>(m[2]) * point[2] + m[3];
    }
    OpaqueVertex v;
    v.inverse_depth = 1.0 / c[2];
    v.x = samples * (K[0] * c[0] * v.inverse_depth + K[2]);
    v.y = samples * (K[4] * c[1] * v.inverse_depth + K[5]);
    const bool drawn = c[2] > static_cast<double>(near_plane) && is_finite(v.x) && is_finite(v.y);
    const double zero = c[2] - c[2];
    if (!drawn) v.inverse_depth = zero / zero;  // NaN
    return v;
}

// A coordinate relative to the middle of the first sample, clamped to [0, size].
ETSPLAT_FN double from_first_sample(double coordinate, int size) {
    double at = coordinate - 0.5;
    at = at < 0.0 ? 0.0 : at;
    return static_cast<double>(size) < at ? static_cast<double>(size) : at;
}

// The first sample at or after that.
ETSPLAT_FN int next_sample(double at) {
    const int truncated = static_cast<int>(at);
    return truncated + (at > truncated ? 1 : 0);
}

ETSPLAT_FN int first_sample(double coordinate, int size) { return next_sample(from_first_sample(coordinate, size)); }

// Samples that may be in a triangle: none where it cannot be drawn, as it has a vertex behind the near plane or not finite.
struct OpaqueBounds {
    int x_begin, x_end, y_begin, y_end;

    ETSPLAT_FN bool empty() const { return x_begin >= x_end || y_begin >= y_end; }
};

ETSPLAT_FN OpaqueBounds opaque_bounds(const OpaqueVertex* v, int width, int height) {
    if (!is_finite(v[0].inverse_depth + v[1].inverse_depth + v[2].inverse_depth)) return {0, 0, 0, 0};
    double low[2] = {v[0].x, v[0].y}, high[2] = {v[0].x, v[0].y};
    for (int k = 1; k < 3; ++k) {
        low[0] = v[k].x < low[0] ? v[k].x : low[0];
        high[0] = v[k].x > high[0] ? v[k].x : high[0];
        low[1] = v[k].y < low[1] ? v[k].y : low[1];
        high[1] = v[k].y > high[1] ? v[k].y : high[1];
    }
    return {first_sample(low[0], width), first_sample(high[0], width), first_sample(low[1], height),
            first_sample(high[1], height)};
}

struct OpaqueEdge {
    double x, y, slope, x_low, x_high;

    // Where a row meets it, relative to the middle of the first column, clamped to [0, width].
    ETSPLAT_FN double clamped(double sample_y, int width) const {
        double at = x + (sample_y - y) * slope;
        at = at > x_low ? at : x_low;  // the edge's own range, so that both neighbours clamp alike (also a NaN)
        at = at < x_high ? at : x_high;
        return from_first_sample(at, width);
    }

    // Column of the first sample on the right side of the edge.
    ETSPLAT_FN int first_right(double sample_y, int width) const { return next_sample(clamped(sample_y, width)); }
};

ETSPLAT_FN OpaqueEdge opaque_edge(const OpaqueVertex& upper, const OpaqueVertex& lower) {
    const double low = lower.x < upper.x ? lower.x : upper.x, high = upper.x < lower.x ? lower.x : upper.x;
    return {upper.x, upper.y, (lower.x - upper.x) / (lower.y - upper.y), low, high};
}

struct OpaqueTriangle {
    OpaqueEdge whole, upper, lower;  // from the top vertex to the bottom one, top to middle, middle to bottom
    double inverse_depth, inverse_depth_dx, inverse_depth_dy;  // plane, at the top vertex
    float inverse_depth_min, inverse_depth_max;
    OpaqueBounds bounds;

    // Columns [begin, end) that it covers on row y.
    ETSPLAT_FN void span(int y, int width, int& begin, int& end) const {
        const double sample_y = y + 0.5;
        const int a = whole.first_right(sample_y, width);
        const int b = (sample_y < lower.y ? upper : lower).first_right(sample_y, width);
        begin = a < b ? a : b;
        end = a < b ? b : a;
    }

    // Inverse depth of row y at the first column of the bounds.
    ETSPLAT_FN float row_inverse_depth(int y) const {
        return static_cast<float>(inverse_depth + inverse_depth_dy * (y + 0.5 - whole.y) +
                                  inverse_depth_dx * (bounds.x_begin + 0.5 - whole.x));
    }

    // Inverse depth `column` samples right of that, on a row that starts with `row`: the same number whoever asks.
    ETSPLAT_FN float inverse_depth_at(float row, float slope, int column) const {
        float w = row + slope * static_cast<float>(column);
        w = w < inverse_depth_min ? inverse_depth_min : w;  // slivers must not extrapolate
        return w > inverse_depth_max ? inverse_depth_max : w;
    }
};

// False if it draws nothing: no sample in its bounds, no area, facing away.
ETSPLAT_FN bool set_up_opaque(const OpaqueVertex* in, const OpaqueBounds& bounds, bool cull_backfaces, OpaqueTriangle& t) {
    if (bounds.empty()) return false;
    if (cull_backfaces) {
        const double facing = (in[1].x - in[0].x) * (in[2].y - in[0].y) - (in[2].x - in[0].x) * (in[1].y - in[0].y);
        if (!(facing < 0.0)) return false;  // y points down: counter-clockwise is negative
    }
    OpaqueVertex v[3] = {in[0], in[1], in[2]};
    for (int i = 0; i < 3; ++i) {  // by y, then x: pairs 01, 12, 01
        OpaqueVertex &a = v[i % 2], &b = v[i % 2 + 1];
        if (b.y < a.y || (b.y == a.y && b.x < a.x)) {
            const OpaqueVertex swapped = a;
            a = b;
            b = swapped;
        }
    }

    const double x1 = v[1].x - v[0].x, y1 = v[1].y - v[0].y, x2 = v[2].x - v[0].x, y2 = v[2].y - v[0].y;
    const double w1 = v[1].inverse_depth - v[0].inverse_depth, w2 = v[2].inverse_depth - v[0].inverse_depth;
    const double area = x1 * y2 - x2 * y1;
    t.inverse_depth = v[0].inverse_depth;
    t.inverse_depth_dx = (w1 * y2 - w2 * y1) / area;
    t.inverse_depth_dy = (x1 * w2 - x2 * w1) / area;
    if (!is_finite(t.inverse_depth_dx) || !is_finite(t.inverse_depth_dy)) return false;

    double low = v[0].inverse_depth, high = v[0].inverse_depth;
    for (int k = 1; k < 3; ++k) {
        low = v[k].inverse_depth < low ? v[k].inverse_depth : low;
        high = v[k].inverse_depth > high ? v[k].inverse_depth : high;
    }
    t.inverse_depth_min = static_cast<float>(low);
    t.inverse_depth_max = static_cast<float>(high);
    t.whole = opaque_edge(v[0], v[2]);
    t.upper = opaque_edge(v[0], v[1]);
    t.lower = opaque_edge(v[1], v[2]);
    t.bounds = bounds;
    return true;
}

// Perspective-correct barycentrics b_k = (a_k / z_k) / sum_j (a_j / z_j), a clamped at 0, of the sample at column x and
// row y.
ETSPLAT_FN void opaque_barycentrics(const OpaqueVertex* vertices, int x, int y, float* out) {
    OpaqueVertex v[3];
    for (int k = 0; k < 3; ++k) {
        v[k] = vertices[k];
        v[k].x -= x + 0.5;
        v[k].y -= y + 0.5;
    }
    double weight[3];
    for (int k = 0; k < 3; ++k) {
        const OpaqueVertex &p = v[(k + 1) % 3], &q = v[(k + 2) % 3];
        weight[k] = p.x * q.y - q.x * p.y;
    }
    const double sign = weight[0] + weight[1] + weight[2] < 0.0 ? -1.0 : 1.0;
    for (int k = 0; k < 3; ++k) {
        const double clamped = sign * weight[k] > 0.0 ? sign * weight[k] : 0.0;
        weight[k] = clamped * v[k].inverse_depth;
    }
    const double total = weight[0] + weight[1] + weight[2];
    for (int k = 0; k < 3; ++k) out[k] = total > 0.0 ? static_cast<float>(weight[k] / total) : 1.0f / 3.0f;
}

}  // namespace etsplat
