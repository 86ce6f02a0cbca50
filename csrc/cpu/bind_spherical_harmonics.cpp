// Points run in parallel; a point's views run in order, so that sums over views do not depend on the threads.
#include <algorithm>
#include <vector>

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

// Channels = 0 reads the number of channels from the problem.
template <int Channels>
void forward(const ShProblem& p, float* colors) {
    const int64_t channels = Channels > 0 ? Channels : p.channels;
    parallel_for(p.points, kPoints, [&](int64_t begin, int64_t end) {
        float basis[kMaxShBases], length;
        Vector unit;
        for (int64_t n = begin; n < end; ++n) {
            const float* coefficients = p.coefficients + n * p.bases * channels;
            for (int64_t view = 0; view < p.views; ++view) {
                const int degree = sh_direction(p.degree, p.directions[view * p.points + n], unit, length);
                sh_basis(degree, unit, basis);
                float* color = colors + (view * p.points + n) * channels;
                for (int64_t c = 0; c < channels; ++c) {
                    float sum = 0.5f;
                    for (int k = 0; k < (degree + 1) * (degree + 1); ++k) {
                        sum += basis[k] * coefficients[k * channels + c];
                    }
                    color[c] = vmax(sum, 0.0f);
                }
            }
        }
    });
}

// grad_coefficients (N, bases, channels), grad_directions (views, N); a colour of 0 was clamped and passes no gradient.
template <int Channels>
void backward(const ShProblem& p, const float* colors, const float* grad_colors, float* grad_coefficients,
              Vector* grad_directions) {
    const int64_t channels = Channels > 0 ? Channels : p.channels;
    parallel_for(p.points, kPoints, [&](int64_t begin, int64_t end) {
        float basis[kMaxShBases], along[kMaxShBases], length;
        Vector unit;
        std::vector<float> cotangent(channels);
        for (int64_t n = begin; n < end; ++n) {
            const float* coefficients = p.coefficients + n * p.bases * channels;
            float* sums = grad_coefficients + n * p.bases * channels;
            std::fill(sums, sums + p.bases * channels, 0.0f);
            for (int64_t view = 0; view < p.views; ++view) {
                const int64_t at = view * p.points + n;
                const int degree = sh_direction(p.degree, p.directions[at], unit, length);
                sh_basis(degree, unit, basis);
                for (int64_t c = 0; c < channels; ++c) {
                    cotangent[c] = colors[at * channels + c] > 0.0f ? grad_colors[at * channels + c] : 0.0f;
                }
                for (int k = 0; k < (degree + 1) * (degree + 1); ++k) {
                    along[k] = 0.0f;
                    for (int64_t c = 0; c < channels; ++c) {
                        sums[k * channels + c] += cotangent[c] * basis[k];
                        along[k] += cotangent[c] * coefficients[k * channels + c];
                    }
                }
                const Vector g = sh_basis_backward(degree, unit, along);
                grad_directions[at] = sh_direction_backward(degree, unit, length, g);
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
            const auto run = channels == 3 ? forward<3> : forward<0>;
            run({pointer<const float>(coefficients), pointer<const Vector>(directions), points, views, bases, channels,
                 degree},
                pointer<float>(colors));
        },
        NoGil());
    m.def(
        "spherical_harmonics_backward",
        [](Address coefficients, Address directions, int64_t points, int64_t views, int64_t bases, int64_t channels,
           int degree, Address colors, Address grad_colors, Address grad_coefficients, Address grad_directions) {
            const auto run = channels == 3 ? backward<3> : backward<0>;
            run({pointer<const float>(coefficients), pointer<const Vector>(directions), points, views, bases, channels,
                 degree},
                pointer<const float>(colors), pointer<const float>(grad_colors), pointer<float>(grad_coefficients),
                pointer<Vector>(grad_directions));
        },
        NoGil());
}

}  // namespace etsplat
