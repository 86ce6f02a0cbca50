// How deep points are within silhouettes (src/etsplat/data/silhouettes.py and carving.py say what for).
#pragma once

#include <cstdint>
#include <vector>

namespace etsplat {

struct SilhouetteView {
    const float* distance;  // (height, width) pixels to the outline, negative outside
    int32_t width, height;
    const float* viewmat;   // (4, 4) world to camera
    const float* K;         // (3, 3)
    bool whole;             // judges points beyond its picture, too
};

struct CarvingRule {
    float grown;   // pixels by which silhouettes are taken to be larger
    bool in_units; // depths in units of the scene, otherwise in pixels
};

// depth[k] is how deep a point is within the silhouette that has it (k + 1)-th least deep among the views that judge it, infinite if
// fewer do; judges[n] says how many do. The view own[n], if there is one, does not judge point n.
// points (N, 3), own (N,) or null, depth (count, N), judges (N,).
void lowest_depths(const std::vector<SilhouetteView>& views, const CarvingRule& rule, const float* points, const int64_t* own,
                   int64_t N, int64_t count, float* depth, float* judges);

// cost[n] is how many pixels point n is outside of the silhouettes that judge it, together, of each no more than most[view]. What is within
// one, or not judged, costs a little less than nothing, so that of points that none excludes one deep within all is best.
void exclusion_costs(const std::vector<SilhouetteView>& views, const float* most, const float* points, int64_t N, float* cost);

}  // namespace etsplat
