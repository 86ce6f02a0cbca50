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

ShProblem problem(const Array<const float, 3>& coefficients, const Array<const float>& directions, int degree) {
    return {coefficients.data(),
            reinterpret_cast<const Vector*>(directions.data()),
            coefficients.size(0),
            directions.rank() == 3 ? directions.size(0) : 1,
            coefficients.size(1),
            coefficients.size(2),
            degree};
}

}  // namespace

void bind_spherical_harmonics(nb::module_& m) {
    // coefficients (N, bases, channels); directions (views, N, 3) and colors (views, N, channels), or without views.
    def_function(
        m, "spherical_harmonics",
        [](Array<const float, 3> coefficients, Array<const float> directions, int degree, Array<float> colors) {
            const auto run = coefficients.size(2) == 3 ? forward<3> : forward<0>;
            run(problem(coefficients, directions, degree), colors.data());
        },
        "coefficients", "directions", "degree", "colors");
    def_function(
        m, "spherical_harmonics_backward",
        [](Array<const float, 3> coefficients, Array<const float> directions, int degree, Array<const float> colors,
           Array<const float> grad_colors, Array<float, 3> grad_coefficients, Array<float> grad_directions) {
            const auto run = coefficients.size(2) == 3 ? backward<3> : backward<0>;
            run(problem(coefficients, directions, degree), colors.data(), grad_colors.data(), grad_coefficients.data(),
                reinterpret_cast<Vector*>(grad_directions.data()));
        },
        "coefficients", "directions", "degree", "colors", "grad_colors", "grad_coefficients", "grad_directions");
}

}  // namespace etsplat
