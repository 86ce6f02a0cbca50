#include "halving_sums.h"

#include <algorithm>
#include <cmath>

#include "parallel.h"
#include "prefetch.h"

namespace etsplat {
namespace {

constexpr int64_t kAhead = 8;  // pixels: their sums lie anywhere in memory
constexpr int kProducts = 6;
constexpr int kOfSquare[3][3] = {{0, 1, 2}, {1, 3, 4}, {2, 4, 5}};  // which of them each product of barycentrics is
constexpr double kRidge = 1.0;  // corrections keep to none, those of halves to that of the whole, as if so many pixels said so

struct Square {
    double at[3][3];
};

// Normal equations: products of barycentrics, then of these and what pixels lack, a column a channel.
struct Equations {
    double sums[kHalvingSums];

    Square pulls() const {
        Square found;
        std::copy(sums + kProducts, sums + kHalvingSums, &found.at[0][0]);
        return found;
    }

    // Products times corrections.
    Square times(const Square& corrections) const {
        Square found;
        for (int i = 0; i < 3; ++i) {
            for (int c = 0; c < 3; ++c) {
                found.at[i][c] = 0.0;
                for (int j = 0; j < 3; ++j) found.at[i][c] += sums[kOfSquare[i][j]] * corrections.at[j][c];
            }
        }
        return found;
    }

    // With the ridge, by the root of the products (Cholesky), which the ridge makes definite.
    Square solved(const Square& pulls) const {
        double root[3][3];
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j <= i; ++j) {
                double rest = sums[kOfSquare[i][j]] + (i == j ? kRidge : 0.0);
                for (int k = 0; k < j; ++k) rest -= root[i][k] * root[j][k];
                root[i][j] = i == j ? std::sqrt(rest) : rest / root[j][j];
            }
        }
        Square found = pulls;
        for (int c = 0; c < 3; ++c) {
            for (int i = 0; i < 3; ++i) {
                for (int k = 0; k < i; ++k) found.at[i][c] -= root[i][k] * found.at[k][c];
                found.at[i][c] /= root[i][i];
            }
            for (int i = 2; i >= 0; --i) {
                for (int k = i + 1; k < 3; ++k) found.at[i][c] -= root[k][i] * found.at[k][c];
                found.at[i][c] /= root[i][i];
            }
        }
        return found;
    }

    // What corrections leave of the sum of squares, but for a part that is the same for all of them.
    double left_by(const Square& corrections) const {
        const Square times = this->times(corrections);
        const double* pull = sums + kProducts;
        double sum = 0.0;
        for (int i = 0; i < 3; ++i) {
            for (int c = 0; c < 3; ++c) sum += corrections.at[i][c] * (times.at[i][c] - 2.0 * pull[3 * i + c]);
        }
        return sum;
    }
};

Equations operator+(Equations a, const Equations& b) {
    for (int i = 0; i < kHalvingSums; ++i) a.sums[i] += b.sums[i];
    return a;
}

Equations operator-(Equations a, const Equations& b) {
    for (int i = 0; i < kHalvingSums; ++i) a.sums[i] -= b.sums[i];
    return a;
}

Square operator-(Square a, const Square& b) {
    for (int i = 0; i < 9; ++i) (&a.at[0][0])[i] -= (&b.at[0][0])[i];
    return a;
}

Square operator+(Square a, const Square& b) {
    for (int i = 0; i < 9; ++i) (&a.at[0][0])[i] += (&b.at[0][0])[i];
    return a;
}

// The equations of the two halves of a face by a part of the photos.
struct Halves {
    Equations of[2];

    explicit Halves(const float* sums) {
        for (int half = 0; half < 2; ++half) {
            std::copy(sums + half * kHalvingSums, sums + (half + 1) * kHalvingSums, of[half].sums);
        }
    }

    bool shown() const {
        double size = 0.0;
        for (const Equations& half : of) size += half.sums[0] + half.sums[3] + half.sums[5];
        return size > 0.0;
    }
};

// What halves gain in photos that their corrections do not know, `known` being all others.
double gain(const Halves& known, const Halves& tried) {
    const Equations both = known.of[0] + known.of[1];
    const Square whole = both.solved(both.pulls());
    double gained = 0.0;
    for (int half = 0; half < 2; ++half) {
        const Equations& own = known.of[half];
        const Square corrected = whole + own.solved(own.pulls() - own.times(whole));
        gained += tried.of[half].left_by(whole) - tried.of[half].left_by(corrected);
    }
    return gained;
}

}  // namespace

void add_halving_sums(const HalvingPixels& pixels, const int64_t* longest, float* sums) {
    for (int64_t p = 0; p < pixels.size; ++p) {
        if (p + kAhead < pixels.size && pixels.face[p + kAhead] >= 0) {
            prefetch(sums + 2 * kHalvingSums * pixels.face[p + kAhead]);
        }
        const int64_t face = pixels.face[p];
        if (face < 0) continue;
        const float *b = pixels.barycentrics + 3 * p, *lacking = pixels.lacking + 3 * p;
        const int64_t start = longest[face];
        const bool second = b[(start + 1) % 3] > b[start];
        const float counted = pixels.counted[p];
        float* into = sums + (2 * face + second) * kHalvingSums;
        for (int i = 0; i < 3; ++i) {
            for (int j = i; j < 3; ++j) *into++ += counted * (b[i] * b[j]);
        }
        for (int i = 0; i < 3; ++i) {
            for (int c = 0; c < 3; ++c) *into++ += counted * (b[i] * lacking[c]);
        }
    }
}

void halving_gains(const float* sums, int64_t parts, int64_t faces, double* gains) {
    parallel_for(faces, 256, [&](int64_t begin, int64_t end) {
        for (int64_t face = begin; face < end; ++face) {
            const auto by = [&](int64_t part) { return Halves(sums + 2 * kHalvingSums * (part * faces + face)); };
            int64_t shown = 0;
            for (int64_t part = 0; part < parts; ++part) shown += by(part).shown();
            gains[face] = 0.0;
            if (shown < 2) continue;
            Halves all = by(0);
            for (int64_t part = 1; part < parts; ++part) {
                for (int half = 0; half < 2; ++half) all.of[half] = all.of[half] + by(part).of[half];
            }
            for (int64_t part = 0; part < parts; ++part) {
                const Halves tried = by(part);
                Halves known = all;
                for (int half = 0; half < 2; ++half) known.of[half] = all.of[half] - tried.of[half];
                gains[face] += gain(known, tried);
            }
        }
    });
}

}  // namespace etsplat
