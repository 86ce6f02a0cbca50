// Points run in parallel; a point's views run in order, so that sums over views do not depend on the threads.
#include <algorithm>

#include "bindings.h"
#include "math/spherical_harmonics.h"
#include "parallel.h"

namespace etsplat {
namespace {

using Vector = Vector3<float>;

constexpr int64_t kPoints = 512;  // that a thread takes at a time

struct ShProblem {
    const float* coefficients;  // (N, bases, channels)
    const Vector* directions;   // (views, N)
    int64_t points, views, bases, channels;
    int degree;
};

// Normalises; a direction without length keeps only the constant band.
int usable_degree(const ShProblem& problem, Vector raw, Vector& unit, float& length) {
    unit = direction(raw, length);
    return length > kMinLength ? problem.degree : 0;
}

void forward(const ShProblem& p, float* colors) {
    parallel_for(p.points, kPoints, [&](int64_t begin, int64_t end) {
        float basis[kMaxShBases], length;
        Vector unit;
        for (int64_t n = begin; n < end; ++n) {
            const float* coefficients = p.coefficients + n * p.bases * p.channels;
            for (int64_t view = 0; view < p.views; ++view) {
                const int degree = usable_degree(p, p.directions[view * p.points + n], unit, length);
                sh_basis(degree, unit, basis);
                float* color = colors + (view * p.points + n) * p.channels;
                for (int64_t c = 0; c < p.channels; ++c) {
                    float sum = 0.5f;
                    for (int k = 0; k < (degree + 1) * (degree + 1); ++k) sum += basis[k] * coefficients[k * p.channels + c];
                    color[c] = vmax(sum, 0.0f);
                }
            }
        }
    });
}

// grad_coefficients (N, bases, channels), grad_directions (views, N); a colour of 0 was clamped and passes no gradient.
void backward(const ShProblem& p, const float* colors, const float* grad_colors, float* grad_coefficients,
              Vector* grad_directions) {
    parallel_for(p.points, kPoints, [&](int64_t begin, int64_t end) {
        float basis[kMaxShBases], along[kMaxShBases], length;
        Vector unit;
        std::fill(grad_coefficients + begin * p.bases * p.channels, grad_coefficients + end * p.bases * p.channels, 0.0f);
        for (int64_t n = begin; n < end; ++n) {
            const float* coefficients = p.coefficients + n * p.bases * p.channels;
            float* sums = grad_coefficients + n * p.bases * p.channels;
            for (int64_t view = 0; view < p.views; ++view) {
                const int64_t at = view * p.points + n;
                const int degree = usable_degree(p, p.directions[at], unit, length);
                const int bases = (degree + 1) * (degree + 1);
                sh_basis(degree, unit, basis);
                std::fill(along, along + bases, 0.0f);
                for (int64_t c = 0; c < p.channels; ++c) {
                    const float g = colors[at * p.channels + c] > 0.0f ? grad_colors[at * p.channels + c] : 0.0f;
                    for (int k = 0; k < bases; ++k) {
                        sums[k * p.channels + c] += g * basis[k];
                        along[k] += g * coefficients[k * p.channels + c];
                    }
                }
                const Vector g = sh_basis_backward(degree, unit, along);
                const float inverse = degree > 0 ? 1.0f / length : 0.0f;
                grad_directions[at] = inverse * (g - dot(g, unit) * unit);  // through the normalisation
            }
        }
    });
}

}  // namespace

void bind_spherical_harmonics(nb::module_& m) {
    // coefficients (N, bases, channels), directions (views, N, 3), colors (views, N, channels), all float32.
    m.def(
        "spherical_harmonics",
        [](Address coefficients, Address directions, int64_t points, int64_t views, int64_t bases, int64_t channels,
           int degree, Address colors) {
            forward({pointer<const float>(coefficients), pointer<const Vector>(directions), points, views, bases,
                     channels, degree},
                    pointer<float>(colors));
        },
        NoGil());
    m.def(
        "spherical_harmonics_backward",
        [](Address coefficients, Address directions, int64_t points, int64_t views, int64_t bases, int64_t channels,
           int degree, Address colors, Address grad_colors, Address grad_coefficients, Address grad_directions) {
            backward({pointer<const float>(coefficients), pointer<const Vector>(directions), points, views, bases,
                      channels, degree},
                     pointer<const float>(colors), pointer<const float>(grad_colors),
                     pointer<float>(grad_coefficients), pointer<Vector>(grad_directions));
        },
        NoGil());
}

}  // namespace etsplat
