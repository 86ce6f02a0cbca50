// Renders one soup with every instruction set of this processor and compares images and gradients with the plain path.
// A program of its own, so that a path can be checked under an emulator where there is no Python: tests/native/run.sh.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <string>
#include <vector>

#include "cpu/instruction_set.h"
#include "math/kernels.h"
#include "scene.h"

using namespace etsplat;
using namespace etsplat::scene;

namespace {

// The share of values that differ by more than `tolerance` of the largest one; NaN differs from everything.
double outliers(const std::vector<float>& a, const std::vector<float>& b, float tolerance) {
    float scale = 1e-30f;
    for (const float v : b) scale = std::max(scale, std::abs(v));
    size_t count = 0;
    for (size_t i = 0; i < a.size(); ++i) count += std::abs(a[i] - b[i]) <= tolerance * scale ? 0 : 1;
    return static_cast<double>(count) / static_cast<double>(std::max<size_t>(1, a.size()));
}

int compare(const char* what, const std::string& path, int kernel, int distance, const Pass& pass,
            const std::vector<float>& a, const std::vector<float>& b, float tolerance) {
    const double share = outliers(a, b, tolerance);
    // pixels on a cut-off may fall on either side of it
    if (share <= 0.005) return 0;
    std::printf("FAILED %s: %s, kernel %d, distance %d, %s pass: %.2f %% differ from plain\n", path.c_str(), what, kernel,
                distance, pass.name, 100 * share);
    return 1;
}

}  // namespace

int main() {
    Scene scene;
    int failures = 0;
    for (const std::string& path : available_instruction_sets()) {
        int comparisons = 0;
        for (int kernel = 0; kernel < kKernels; ++kernel)
            for (int distance = 0; distance < 2; ++distance)
                for (const Pass& pass : kPasses) {
                    set_instruction_set("plain");
                    const Result expected = render(scene, kernel, distance, pass);
                    const bool drawn = *std::max_element(expected.alpha.begin(), expected.alpha.end()) > 0.5f;
                    if (!drawn) std::printf("FAILED: the scene is empty\n"), ++failures;
                    set_instruction_set(path);
                    const Result actual = render(scene, kernel, distance, pass);
#define COMPARE(field, tolerance) \
    failures += compare(#field, path, kernel, distance, pass, actual.field, expected.field, tolerance), ++comparisons
                    COMPARE(color, 1e-5f);
                    COMPARE(alpha, 1e-5f);
                    COMPARE(distortion, 1e-5f);
                    COMPARE(median, 0.0f);
                    COMPARE(weights, 1e-5f);
                    COMPARE(vertices, 1e-4f);
                    COMPARE(flat, 1e-4f);
                    COMPARE(corner, 1e-4f);
                    COMPARE(opacities, 1e-4f);
                    COMPARE(sigmas, 1e-4f);
                    COMPARE(background, 1e-4f);
                    COMPARE(viewmat, 1e-3f);
                    COMPARE(K, 1e-3f);
#undef COMPARE
                }
        std::printf("%s: %d images and gradients compared with plain\n", path.c_str(), comparisons);
    }
    return failures == 0 ? 0 : 1;
}
