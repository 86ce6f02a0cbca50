#include "predicates.h"

#include <cmath>

namespace etsplat {
namespace {

constexpr double half_ulp = 0x1p-53;

int sign(double value) { return (value > 0) - (value < 0); }

// A sum of doubles kept exactly: components of increasing magnitude that do not overlap, zeros left out.
class ExactSum {
public:
    void add(double value) {
        int kept = 0;
        for (int i = 0; i < size_; ++i) {
            const double sum = value + terms_[i];
            const double part = sum - value;
            const double error = (value - (sum - part)) + (terms_[i] - part);
            if (error != 0) terms_[kept++] = error;
            value = sum;
        }
        if (value != 0) terms_[kept++] = value;
        size_ = kept;
    }
    void add_product(double a, double b) {
        const double high = a * b;
        add(std::fma(a, b, -high));
        add(high);
    }
    void add_product(double a, double b, double c) {
        const double high = a * b;
        add_product(std::fma(a, b, -high), c);
        add_product(high, c);
    }
    void add_determinant(double sign, Vec3 a, Vec3 b, Vec3 c) {
        add_product(sign * a.x, b.y, c.z);
        add_product(-sign * a.x, b.z, c.y);
        add_product(sign * a.y, b.z, c.x);
        add_product(-sign * a.y, b.x, c.z);
        add_product(sign * a.z, b.x, c.y);
        add_product(-sign * a.z, b.y, c.x);
    }
    int sign_of_sum() const { return size_ ? sign(terms_[size_ - 1]) : 0; }

private:
    static constexpr int capacity = 24 * 4 + 1;  // four determinants of six triple products, four terms each
    double terms_[capacity];
    int size_ = 0;
};

bool exact_difference(double a, double b) {
    const double difference = a - b;
    const double part = a - difference;
    return part - b == 0 && a - (difference + part) == 0;
}

bool exact_difference(Vec3 a, Vec3 b) {
    return exact_difference(a.x, b.x) && exact_difference(a.y, b.y) && exact_difference(a.z, b.z);
}

int orient3d_exact(Vec3 a, Vec3 b, Vec3 c, Vec3 d) {
    ExactSum sum;
    if (exact_difference(a, d) && exact_difference(b, d) && exact_difference(c, d)) {
        sum.add_determinant(1, a - d, b - d, c - d);  // the common case: the coordinates were float32
    } else {
        sum.add_determinant(1, a, b, c);
        sum.add_determinant(-1, a, b, d);
        sum.add_determinant(1, a, c, d);
        sum.add_determinant(-1, b, c, d);
    }
    return sum.sign_of_sum();
}

}  // namespace

int orient2d(Vec2 a, Vec2 b, Vec2 c) {
    const double left = (a.x - c.x) * (b.y - c.y), right = (a.y - c.y) * (b.x - c.x);
    const double value = left - right;
    const double bound = (3 + 16 * half_ulp) * half_ulp * (std::abs(left) + std::abs(right));
    if (std::abs(value) > bound) return sign(value);
    ExactSum sum;
    sum.add_product(a.x, b.y);
    sum.add_product(-a.y, b.x);
    sum.add_product(b.x, c.y);
    sum.add_product(-b.y, c.x);
    sum.add_product(c.x, a.y);
    sum.add_product(-c.y, a.x);
    return sum.sign_of_sum();
}

int orient3d(Vec3 a, Vec3 b, Vec3 c, Vec3 d) {
    const Vec3 u = a - d, v = b - d, w = c - d;
    const double vw1 = v.y * w.z, vw2 = v.z * w.y, wu1 = w.y * u.z, wu2 = w.z * u.y, uv1 = u.y * v.z, uv2 = u.z * v.y;
    const double value = u.x * (vw1 - vw2) + v.x * (wu1 - wu2) + w.x * (uv1 - uv2);
    const double magnitude = std::abs(u.x) * (std::abs(vw1) + std::abs(vw2)) +
                             std::abs(v.x) * (std::abs(wu1) + std::abs(wu2)) +
                             std::abs(w.x) * (std::abs(uv1) + std::abs(uv2));
    if (std::abs(value) > (7 + 56 * half_ulp) * half_ulp * magnitude) return sign(value);
    // All products zero: equal points, or an axis-aligned plane. Differences are zero only where they are exactly so.
    if (magnitude == 0) return 0;
    return orient3d_exact(a, b, c, d);
}

}  // namespace etsplat
