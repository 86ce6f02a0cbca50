#include "belief_propagation.h"
#include "bindings.h"
#include "photo_agreement.h"

namespace etsplat {

void bind_photo_agreement(nb::module_& m) {
    // Of B photos: pixels (1, 4, H, W) and masks (1, 1, H, W) of each, viewmats (B, 4, 4), Ks (B, 3, 3), centers (B, 3);
    // points and normals (N, 3), seen (B, N), result (N,).
    def_function(
        m, "photo_agreement",
        [](const std::vector<Array<const float, 4>>& pixels, const std::vector<Array<const float, 4>>& masks,
           Array<const float, 3> viewmats, Array<const float, 3> Ks, Array<const float, 2> centers,
           Array<const float, 2> points, Array<const float, 2> normals, Array<const bool, 2> seen, int32_t patch,
           int32_t asked, float slant, float flat, float whole, int32_t fewest, float pixel, Array<float, 1> result) {
            std::vector<AskedPhoto> photos;
            for (size_t b = 0; b < pixels.size(); ++b) {
                const auto index = static_cast<int64_t>(b);
                photos.push_back({pixels[b].data(), masks[b].data(), static_cast<int32_t>(pixels[b].size(3)),
                                  static_cast<int32_t>(pixels[b].size(2)), viewmats.row(index), Ks.row(index),
                                  centers.row(index)});
            }
            const AgreementRules rules{patch, asked, slant, flat, whole, fewest, pixel};
            photo_agreement(photos, rules, points.data(), normals.data(), seen.data(), points.size(0), result.data());
        },
        "pixels", "masks", "viewmats", "Ks", "centers", "points", "normals", "seen", "patch", "asked", "slant", "flat",
        "whole", "fewest", "pixel", "result");
    // pixels (1, 4, H, W), seen and each of shown (H, W), colors (F, 3), sums (F, 1 + shown).
    def_function(
        m, "add_differences",
        [](Array<const float, 4> pixels, float opaque, Array<const int64_t, 2> seen,
           const std::vector<Array<const int64_t, 2>>& shown, Array<const float, 2> colors, Array<float, 2> sums) {
            std::vector<const int64_t*> faces;
            for (const auto& each : shown) faces.push_back(each.data());
            add_differences(pixels.data(), seen.count(), opaque, seen.data(), faces, colors.data(), sums.data());
        },
        "pixels", "opaque", "seen", "shown", "colors", "sums");
    // cost and belief (N, D), edges (E, 2).
    def_function(
        m, "propagate_beliefs",
        [](Array<const float, 2> cost, Array<const int64_t, 2> edges, float bend, float tear, int64_t rounds,
           Array<float, 2> belief) {
            propagate_beliefs(cost.data(), cost.size(0), cost.size(1), edges.data(), edges.size(0), {bend, tear}, rounds,
                              belief.data());
        },
        "cost", "edges", "bend", "tear", "rounds", "belief");
}

}  // namespace etsplat
