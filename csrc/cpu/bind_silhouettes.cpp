#include "bindings.h"
#include "silhouettes.h"

namespace etsplat {
namespace {

std::vector<SilhouetteView> views_of(const std::vector<Array<const float, 4>>& distances,
                                     const Array<const float, 3>& viewmats, const Array<const float, 3>& Ks,
                                     const Array<const bool, 1>& whole) {
    std::vector<SilhouetteView> views;
    for (size_t b = 0; b < distances.size(); ++b) {
        const auto index = static_cast<int64_t>(b);
        views.push_back({distances[b].data(), static_cast<int32_t>(distances[b].size(3)),
                         static_cast<int32_t>(distances[b].size(2)), viewmats.row(index), Ks.row(index),
                         whole.data()[b]});
    }
    return views;
}

}  // namespace

void bind_silhouettes(nb::module_& m) {
    // Of B views: distances (1, 1, H, W) of each, viewmats (B, 4, 4), Ks (B, 3, 3), whole (B,); points (N, 3).
    // own (N,), depth (K, N), judges (N,).
    def_function(
        m, "lowest_depths",
        [](const std::vector<Array<const float, 4>>& distances, Array<const float, 3> viewmats,
           Array<const float, 3> Ks, Array<const bool, 1> whole, Array<const float, 2> points,
           OptionalArray<const int64_t, 1> own, float grown, bool in_units, Array<float, 2> depth,
           Array<float, 1> judges) {
            lowest_depths(views_of(distances, viewmats, Ks, whole), {grown, in_units}, points.data(), data_or_null(own),
                          points.size(0), depth.size(0), depth.data(), judges.data());
        },
        "distances", "viewmats", "Ks", "whole", "points", "own", "grown", "in_units", "depth", "judges");
    // most (B,), cost (N,).
    def_function(
        m, "exclusion_costs",
        [](const std::vector<Array<const float, 4>>& distances, Array<const float, 3> viewmats,
           Array<const float, 3> Ks, Array<const bool, 1> whole, Array<const float, 2> points,
           Array<const float, 1> most, Array<float, 1> cost) {
            exclusion_costs(views_of(distances, viewmats, Ks, whole), most.data(), points.data(), points.size(0),
                            cost.data());
        },
        "distances", "viewmats", "Ks", "whole", "points", "most", "cost");
}

}  // namespace etsplat
