// The data of a sweep of planes through what a photo shows and the interface of its loops, which exist once per
// instruction set (simd/plane_sweep.h). src/etsplat/data/plane_matches.py says what for.
#pragma once

#include <cstdint>
#include <vector>

namespace etsplat {

constexpr int64_t kSweepLanes = 16;  // pixels side by side; a row's stride is a multiple of it
constexpr int64_t kMostSwept = 8;    // neighbours of a photo

// A photo that another one is compared with.
struct SweptNeighbour {
    const float* quads;  // (height + 2, width + 2, 4) the pixels around each place between pixels, black beyond the photo
    int64_t width, height;
    const float* rays;   // (3, 3) from a place (x, y, 1) in the other photo to its ray, as this one projects it
    const float* start;  // (3,) where rays begin, likewise
};

struct PlaneSweep {
    const float* grey;      // (height, stride), 0 beyond the photo
    const float* mean;      // (height, stride) in the window around each pixel
    const float* variance;  // (height, stride)
    const float* across;    // (stride,) 1 over how many pixels of a window are in the photo along x
    const float* down;      // (height,) along y
    int64_t width, height, stride;
    std::vector<SweptNeighbour> neighbours;
    int64_t reach;     // pixels on each side of a window's middle
    int64_t agreeing;  // the mean of so many correlations, the best ones, counts
    int64_t beside;    // planes up to so far from the best one are beside it
    float least_variance, least_depth;  // what is divided by is no less
    const float* inverse;  // (planes,) 1 over their depths
    int64_t planes;
    float* judged;  // (height, planes, stride) mean correlations
};

// Of each pixel, (height, width).
struct SweptPlanes {
    float* place;      // the number of the best plane, with a fraction; -1 where it is the first or the last
    float* best;       // its correlation
    float* elsewhere;  // the best one of planes that are not beside it
};

struct PlaneSweepKernels {
    void (*judge)(const PlaneSweep&, int64_t plane, float* scratch);  // writes a plane of `judged`
    void (*choose)(const PlaneSweep&, int64_t row, const SweptPlanes&);
};

// Of rows that windows reach, what is kept: sums along x of what a neighbour shows, of its square and of its product with
// the photo, and whether it shows that.
constexpr int64_t kSweptSums = 3, kSweptRows = kSweptSums + 1;

// floats: those rows, and a row of each of the three with zeros on both sides
inline int64_t plane_sweep_scratch(const PlaneSweep& sweep) {
    const auto neighbours = static_cast<int64_t>(sweep.neighbours.size());
    return neighbours * (2 * sweep.reach + 1) * kSweptRows * sweep.stride + kSweptSums * (sweep.stride + 2 * kSweepLanes);
}

}  // namespace etsplat
