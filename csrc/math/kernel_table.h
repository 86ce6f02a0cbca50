// A kernel that was registered from Python, read from a table (src/etsplat/core/kernel_table.py, which lays it out).
//
// In x it is a cubic between knots, in log sigma linear between rows. The knots lie in three zones, each in octaves around
// a pivot: with u, an affine function of |x - pivot|, written as mantissa 2^exponent with a mantissa in [3/4, 3/2), an
// octave is one exponent, and its cells are equal parts of the mantissa. A row has a pair (value, slope dG/du) for each
// knot of each zone, from the pivot on, so that a cell is four consecutive floats.
//
// The table is one array of floats: TableHeader; the knots in x, ascending; for each pair of rows what the larger one
// reaches at a knot or anywhere to its right; the rows.
#pragma once

#include "portable.h"

namespace etsplat {

struct TableZone {
    float pivot;
    float scale;  // du/dx
    float first;  // u at the pivot
    float start;  // index of the knot at which the octave of exponent 0 would begin
    float cells;  // in an octave
    float width;  // of a cell, in u, in the octave of exponent 0
};

struct TableHeader {
    float first_log2_sigma, rows_per_log2;
    float rows, knots, row_size;  // numbers of each, floats in a row
    TableZone zones[3];  // x < 1/2, x <= 1, above
};
constexpr int kTableHeader = sizeof(TableHeader) / sizeof(float);

// Where x lies in a row, and the cubic's four weights there.
template <class T>
struct TablePlace {
    T index;        // of the cell's first float
    T t, width;     // in the cell, from 0 to 1, and its width in u
    T du_dx;
    T weight[4];    // of value, slope, next value, next slope
};

// The two rows around a sigma.
template <class T>
struct TableRows {
    T index;   // of the first float of the lower one
    T upper;   // weight of the upper one
};

struct Tabulated {
    static constexpr bool kEndsAtOne = false;
    const float* table;

    // The place among the rows, and its derivative by sigma: 0 outside of the range, where the nearest row counts.
    template <class T>
    ETSPLAT_FN KernelCoefficients<T> coefficients(T sigma) const {
        const TableHeader& h = header();
        const T place = (vlog2(sigma) - T(h.first_log2_sigma)) * T(h.rows_per_log2);
        const T inside = vmin(vmax(place, T(0.0f)), T(h.rows - 1.0f));
        const T slope = T(h.rows_per_log2 * kLog2E) / sigma;
        return {inside, vselect(vabs(place - inside) > T(1e-3f), T(0.0f), slope)};
    }

    template <class T>
    ETSPLAT_FN T value(T x, T row, T) const {
        const TableRows<T> rows = rows_of(row);
        const TablePlace<T> place = locate(x);
        T low[4], high[4];
        read(rows, place, low, high);
        return blend(rows, place, low, high);
    }

    template <class T>
    ETSPLAT_FN KernelValue<T> gradient(T x, T row, T rows_per_sigma) const {
        const TableRows<T> rows = rows_of(row);
        KernelValue<T> g = derivatives(x, rows, rows_per_sigma);
        const auto rim = vabs(x - T(1.0f)) < T(kMinInnerDistance);
        if (vany(rim)) {  // rare
            const T beside = vselect(x < T(1.0f), T(1.0f - kMinInnerDistance), T(1.0f + kMinInnerDistance));
            const KernelValue<T> floored = derivatives(vselect(rim, beside, x), rows, rows_per_sigma);
            g.dx = floored.dx;
            g.dsigma = floored.dsigma;
        }
        return g;
    }

    // A cell past the last knot at which either row reaches 1 / ratio; negative if no knot does.
    template <class T>
    ETSPLAT_FN T support(T ratio, T sigma) const {
        const TableHeader& h = header();
        const T threshold = T(1.0f) / ratio, row = vmin(vfloor(coefficients(sigma).exponent), T(h.rows - 2.0f));
        const float* reached = knots() + static_cast<int>(h.knots);
        const T start = row * T(h.knots), end(h.knots - 1.0f);
        T last(-1.0f);
        for (int step = 128; step > 0; step /= 2) {
            const T next = vmin(last + T(static_cast<float>(step)), end);
            last = vselect(vlookup(reached, start + next) >= threshold, next, last);
        }
        return vselect(last < T(0.0f), T(-1.0f), vlookup(knots(), vmin(last + T(1.0f), end)));
    }

private:
    ETSPLAT_FN const TableHeader& header() const { return *reinterpret_cast<const TableHeader*>(table); }
    ETSPLAT_FN const float* knots() const { return table + kTableHeader; }
    ETSPLAT_FN const float* rows() const {
        return knots() + static_cast<int>(header().knots) * static_cast<int>(header().rows);
    }

    template <class T>
    ETSPLAT_FN TableRows<T> rows_of(T row) const {
        const TableHeader& h = header();
        const T lower = vmin(vfloor(row), T(h.rows - 2.0f));
        return {lower * T(h.row_size), row - lower};
    }

    template <class T>
    ETSPLAT_FN TablePlace<T> locate(T x) const {
        const TableHeader& h = header();
        const TableZone &inner = h.zones[0], &edge = h.zones[1], &outer = h.zones[2];
        const auto is_inner = x < T(0.5f), is_outer = x > T(1.0f);
        TablePlace<T> p;
        p.du_dx = vselect(is_inner, T(inner.scale), vselect(is_outer, T(outer.scale), T(edge.scale)));
        const T first = vselect(is_inner, T(inner.first), vselect(is_outer, T(outer.first), T(edge.first)));
        const T start = vselect(is_inner, T(inner.start), vselect(is_outer, T(outer.start), T(edge.start)));
        const T from_pivot = x - vselect(is_inner, T(inner.pivot), T(edge.pivot));
        const T u = vmax(vmin(vfma(from_pivot, p.du_dx, first), T(0.7499999f)), first);
        T mantissa, exponent;
        vsplit(u, mantissa, exponent);
        const T cells = vselect(is_inner, T(inner.cells), vselect(is_outer, T(outer.cells), T(edge.cells)));
        const T width = vselect(is_inner, T(inner.width), vselect(is_outer, T(outer.width), T(edge.width)));
        const T in_octave = (mantissa - T(0.75f)) * (cells * T(1.0f / 0.75f));
        const T cell = vfloor(in_octave);
        p.t = in_octave - cell;
        p.width = vscale(width, exponent);
        p.index = (vfma(exponent, cells, start) + cell) * T(2.0f);
        const T rest = T(1.0f) - p.t, part = p.width * p.t * rest;
        p.weight[2] = p.t * p.t * vfma(p.t, T(-2.0f), T(3.0f));
        p.weight[0] = T(1.0f) - p.weight[2];
        p.weight[1] = part * rest;
        p.weight[3] = T(0.0f) - part * p.t;
        return p;
    }

    template <class T>
    ETSPLAT_FN void read(const TableRows<T>& at, const TablePlace<T>& place, T (&low)[4], T (&high)[4]) const {
        const T index = at.index + place.index;
        vlookup4(rows(), index, low);
        vlookup4(rows() + static_cast<int>(header().row_size), index, high);
    }

    // The cubic through the blend of both rows, which takes its place in `low`; `high` becomes the difference.
    template <class T>
    ETSPLAT_FN T blend(const TableRows<T>& at, const TablePlace<T>& place, T (&low)[4], T (&high)[4]) const {
        for (int k = 0; k < 4; ++k) {
            high[k] = high[k] - low[k];
            low[k] = vfma(at.upper, high[k], low[k]);
        }
        return weighted(place.weight, low);
    }

    template <class T>
    ETSPLAT_FN static T weighted(const T (&weight)[4], const T (&cell)[4]) {
        return vfma(weight[0], cell[0], vfma(weight[2], cell[2], vfma(weight[1], cell[1], weight[3] * cell[3])));
    }

    template <class T>
    ETSPLAT_FN KernelValue<T> derivatives(T x, const TableRows<T>& at, T rows_per_sigma) const {
        const TablePlace<T> place = locate(x);
        T low[4], high[4];
        read(at, place, low, high);
        KernelValue<T> g;
        g.value = blend(at, place, low, high);
        const T t = place.t, rest = T(1.0f) - t;
        const T steep = T(6.0f) * t * rest * (low[2] - low[0]) / place.width;
        const T slope = vfma(rest * vfma(t, T(-3.0f), T(1.0f)), low[1], vfma(t * vfma(t, T(3.0f), T(-2.0f)), low[3], steep));
        g.dx = slope * place.du_dx;
        g.dsigma = weighted(place.weight, high) * rows_per_sigma;
        return g;
    }
};

}  // namespace etsplat
