// Colours of separate triangles as cameras see them: view direction of the centroid and spherical harmonics in one sweep.
// Triangles run in parallel; a triangle's views run in order, so that sums over views do not depend on the threads.
#include <algorithm>

#include "bindings.h"
#include "instruction_set.h"
#include "parallel.h"

namespace etsplat {
namespace {

using Vector = Vector3<float>;

constexpr int64_t kTriangles = 512;  // that a thread takes at a time

Vector centroid(const ColorsPass& p, int64_t n) {
    const Vector* corner = p.corners + 3 * n;
    return (1.0f / 3.0f) * (corner[0] + corner[1] + corner[2]);
}

// One triangle: of the last, fewer than a group.
void forward(const ColorsPass& p, int64_t n, float* colors) {
    const Vector middle = centroid(p, n);
    for (int64_t view = 0; view < p.views; ++view)
        soup_color(p.degree, middle - p.centers[view], p.dc + 3 * n, p.rest + 3 * p.bases * n,
                   colors + 3 * (view * p.triangles + n));
}

// A colour of 0 was clamped and passes no gradient. The bands above `degree` get zero.
void backward(const ColorsPass& p, int64_t n, const ColorsGradients& out) {
    float* rest = out.rest + 3 * p.bases * n;
    std::fill(rest, rest + 3 * p.bases, 0.0f);
    const Vector middle = centroid(p, n);
    Vector moved{0.0f, 0.0f, 0.0f};
    for (int c = 0; c < 3; ++c) out.dc[3 * n + c] = 0.0f;
    for (int64_t view = 0; view < p.views; ++view) {
        const int64_t at = 3 * (view * p.triangles + n);
        float cotangent[3];
        for (int c = 0; c < 3; ++c) cotangent[c] = out.colors[at + c] > 0.0f ? out.grad_colors[at + c] : 0.0f;
        if (cotangent[0] == 0.0f && cotangent[1] == 0.0f && cotangent[2] == 0.0f) continue;  // out of view
        moved = moved + soup_color_backward(p.degree, middle - p.centers[view], p.rest + 3 * p.bases * n, cotangent,
                                            out.dc + 3 * n, rest);
    }
    for (int corner = 0; corner < 3; ++corner) out.corners[3 * n + corner] = (1.0f / 3.0f) * moved;
}

template <class Group, class Single>
void each_group(int64_t triangles, Group group, Single single) {
    parallel_for(triangles, kTriangles, [&](int64_t begin, int64_t end) {
        for (; begin + kColorGroup <= end; begin += kColorGroup) group(begin);
        for (; begin < end; ++begin) single(begin);
    });
}

ColorsPass problem(const Array<const float, 3>& corners, const Array<const float, 3>& dc,
                   const Array<const float, 3>& rest, const Array<const float, 2>& centers, int degree) {
    return {reinterpret_cast<const Vector*>(corners.data()),
            dc.data(),
            rest.data(),
            reinterpret_cast<const Vector*>(centers.data()),
            corners.size(0),
            centers.size(0),
            rest.size(1),
            degree};
}

}  // namespace

void bind_soup_colors(nb::module_& m) {
    // corners (N, 3, 3), dc (N, 1, 3), rest (N, bases, 3), centers (views, 3), colors (views, N, 3).
    def_function(
        m, "soup_colors",
        [](Array<const float, 3> corners, Array<const float, 3> dc, Array<const float, 3> rest,
           Array<const float, 2> centers, int degree, Array<float, 3> colors) {
            const ColorsPass pass = problem(corners, dc, rest, centers, degree);
            const ColorsKernels& kernels = active_colors_kernels();
            each_group(
                pass.triangles, [&](int64_t first) { kernels.forward(pass, first, colors.data()); },
                [&](int64_t n) { forward(pass, n, colors.data()); });
        },
        "corners", "dc", "rest", "centers", "degree", "colors");
    def_function(
        m, "soup_colors_backward",
        [](Array<const float, 3> corners, Array<const float, 3> dc, Array<const float, 3> rest,
           Array<const float, 2> centers, int degree, Array<const float, 3> colors, Array<const float, 3> grad_colors,
           Array<float, 3> grad_corners, Array<float, 3> grad_dc, Array<float, 3> grad_rest) {
            const ColorsPass pass = problem(corners, dc, rest, centers, degree);
            const ColorsGradients out{colors.data(), grad_colors.data(), reinterpret_cast<Vector*>(grad_corners.data()),
                                      grad_dc.data(), grad_rest.data()};
            const ColorsKernels& kernels = active_colors_kernels();
            each_group(
                pass.triangles, [&](int64_t first) { kernels.backward(pass, first, out); },
                [&](int64_t n) { backward(pass, n, out); });
        },
        "corners", "dc", "rest", "centers", "degree", "colors", "grad_colors", "grad_corners", "grad_dc", "grad_rest");
}

}  // namespace etsplat
