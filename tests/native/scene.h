// A soup of random triangles, and one call of the rasterizer that draws it and takes its gradients.
#pragma once

#include <cmath>
#include <cstdint>
#include <random>
#include <vector>

#include "cpu/raster.h"
#include "math/kernels.h"

namespace etsplat::scene {

inline constexpr int kWidth = 75, kHeight = 50, kTriangles = 200;  // partial tiles on two sides
inline constexpr int kMostCorner = 3, kMany = 2500;

// Channels of each kind, and whether everything else is wanted too: one for each Shape of the tile loops. And many triangles
// on the vertices of those few, in three chunks, whose gradients are added up while others are still to come.
struct Pass {
    const char* name;
    int flat, corner;
    bool everything, shared;
    constexpr int triangles() const { return shared ? kMany : kTriangles; }
};
inline constexpr Pass kPasses[] = {
    {"flat", 3, 0, false, false}, {"corner", 0, 3, false, false}, {"general", 3, 2, true, false}, {"shared", 3, 0, false, true}};

// G = exp(-x / sigma) as a table (math/kernel_table.h), for the kernel "Tabulated".
inline std::vector<float> exponential_table() {
    constexpr int kRows = 9, kCells = 4, kOctaves[3] = {3, 6, 3};
    constexpr float kLow = 0.1f, kHigh = 2.0f, kPivot[3] = {0, 1, 1}, kWidth[3] = {0.5f, -0.5f, 1.0f};
    TableHeader header{std::log2(kLow), (kRows - 1) / std::log2(kHigh / kLow), kRows, 0, 0, {}};
    std::vector<float> zones[3], knots;  // x of the knots, from the pivot on
    float start = 0;
    for (int z = 0; z < 3; ++z) {
        const float first = std::ldexp(0.75f, -kOctaves[z]), scale = (0.75f - first) / kWidth[z];
        const auto add = [&](float u) { zones[z].push_back(kPivot[z] + (u - first) / scale); };
        for (int octave = -kOctaves[z]; octave < 0; ++octave)
            for (int cell = 0; cell < kCells; ++cell) add(std::ldexp(0.75f * (1 + static_cast<float>(cell) / kCells), octave));
        add(0.75f);
        const float cells = static_cast<float>(kOctaves[z] * kCells);
        header.zones[z] = {kPivot[z], scale, first, start + cells, kCells, 0.75f / kCells};
        start += cells + 1;
    }
    knots.assign(zones[0].begin(), zones[0].end() - 1);
    knots.insert(knots.end(), zones[1].rbegin(), zones[1].rend());
    knots.insert(knots.end(), zones[2].begin(), zones[2].end());
    header.knots = static_cast<float>(knots.size());
    header.row_size = 2 * start;
    std::vector<float> table(reinterpret_cast<float*>(&header), reinterpret_cast<float*>(&header) + kTableHeader);
    table.insert(table.end(), knots.begin(), knots.end());
    const auto sigma = [&](int row) { return kLow * std::pow(kHigh / kLow, static_cast<float>(row) / (kRows - 1)); };
    for (int row = 1; row < kRows; ++row)
        for (const float x : knots) table.push_back(std::exp(-x / sigma(row)));
    for (int row = 0; row < kRows; ++row)
        for (int z = 0; z < 3; ++z)
            for (const float x : zones[z]) {
                const float value = std::exp(-x / sigma(row));
                table.push_back(value);
                table.push_back(-value / sigma(row) / header.zones[z].scale);
            }
    return table;
}

struct Scene {
    std::vector<float> table = exponential_table();
    std::vector<float> vertices, flat, corner, opacities, sigmas, background{0.1f, 0.4f, 0.7f, 0.2f, 0.9f};
    std::vector<float> viewmat{1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 4, 0, 0, 0, 1};
    std::vector<float> K{60, 0, 37.3f, 0, 55, 25.2f, 0, 0, 1};
    std::vector<float> grad_color, grad_alpha, grad_distortion;
    std::vector<int32_t> faces;

    Scene() {
        std::mt19937 random(1);
        std::uniform_real_distribution<float> unit(0.0f, 1.0f);
        const auto fill = [&](std::vector<float>& out, int n, float low, float high) {
            for (int i = 0; i < n; ++i) out.push_back(low + (high - low) * unit(random));
        };
        for (int i = 0; i < kTriangles; ++i) {
            float center[3];
            for (float& c : center) c = 3.0f * unit(random) - 1.5f;
            for (int k = 0; k < 9; ++k) vertices.push_back(center[k % 3] + 0.8f * unit(random) - 0.4f);
        }
        fill(flat, 3 * kTriangles, 0, 1);
        fill(corner, 3 * kMostCorner * kTriangles, 0, 1);
        fill(opacities, kTriangles, 0.1f, 1);
        fill(sigmas, kTriangles, 0.2f, 1.5f);
        fill(grad_color, 5 * kWidth * kHeight, -1, 1);
        fill(grad_alpha, kWidth * kHeight, -1, 1);
        fill(grad_distortion, kWidth * kHeight, -1, 1);
        for (int i = 0; i < 3 * kMany; ++i) faces.push_back(i % (3 * kTriangles));
        for (std::vector<float>* each : {&flat, &opacities, &sigmas}) {
            const size_t few = each->size();
            for (size_t i = few; i < few / kTriangles * kMany; ++i) each->push_back((*each)[i - few]);
        }
    }
};

struct Result {
    std::vector<float> color, alpha, distortion, median, weights;
    std::vector<float> vertices, flat, corner, opacities, sigmas, background, viewmat, K;
};

inline Result render(Scene& scene, int kernel, int distance, const Pass& pass) {
    const int channels = pass.flat + pass.corner, pixels = kWidth * kHeight, triangles = pass.triangles();
    Result r;
    const auto make = [](std::vector<float>& v, int n) { v.assign(static_cast<size_t>(n), 0.0f); };
    make(r.color, channels * pixels), make(r.alpha, pixels), make(r.distortion, pixels), make(r.weights, triangles);
    make(r.vertices, 9 * kTriangles), make(r.flat, pass.flat * triangles);
    make(r.corner, 3 * pass.corner * triangles);
    make(r.opacities, triangles), make(r.sigmas, triangles), make(r.background, channels), make(r.viewmat, 16), make(r.K, 9);
    std::vector<float> totals(static_cast<size_t>(2 * pixels)), sizes, inradii;
    make(sizes, triangles), make(inradii, triangles);
    std::vector<int32_t> median(static_cast<size_t>(pixels));
    std::vector<uint8_t> visible(static_cast<size_t>(triangles));

    RasterCall call;
    call.vertices = scene.vertices.data();
    if (pass.shared) call.faces = scene.faces.data();
    call.num_triangles = triangles;
    call.num_vertices = 3 * kTriangles;
    call.flat_colors = scene.flat.data();
    call.flat_channels = pass.flat;
    call.corner_colors = scene.corner.data();
    call.corner_channels = pass.corner;
    call.opacities = scene.opacities.data();
    call.sigmas = scene.sigmas.data();
    call.viewmat = scene.viewmat.data();
    call.K = scene.K.data();
    call.background = scene.background.data();
    call.width = kWidth;
    call.height = kHeight;
    call.kernel = kernel;
    call.kernel_table = scene.table.data();
    call.distance = distance;
    call.alpha_min = 1.0f / 255.0f;
    call.alpha_max = 0.99f;
    call.transmittance_min = 0.99e-4f;
    call.keep_for_backward = true;
    call.color = r.color.data();
    call.alpha = r.alpha.data();
    RasterGradients gradients;
    if (pass.everything) {
        call.distortion = r.distortion.data();
        call.distortion_totals = totals.data();
        call.median_triangle = median.data();
        call.max_weight = r.weights.data();
        call.screen_size = sizes.data();
        call.inradius = inradii.data();
        call.visible = reinterpret_cast<bool*>(visible.data());
        gradients.grad_distortion = scene.grad_distortion.data();
    }
    gradients.grad_color = scene.grad_color.data();
    gradients.grad_alpha = scene.grad_alpha.data();
    gradients.vertices = r.vertices.data();
    gradients.flat_colors = r.flat.data();
    gradients.corner_colors = r.corner.data();
    gradients.opacities = r.opacities.data();
    gradients.sigmas = r.sigmas.data();
    gradients.background = r.background.data();
    gradients.viewmat = r.viewmat.data();
    gradients.K = r.K.data();
    const auto state = raster_forward(call);
    raster_backward(*state, call, gradients);
    for (const int32_t triangle : median) r.median.push_back(static_cast<float>(triangle));
    return r;
}

}  // namespace etsplat::scene
