// The first and the third stage of the rasterizer: projection, and the list of (triangle, tile) pairs.
//
//   raster_project  a thread per projected triangle: record, depth key, statistics, the tiles it touches by the exact
//                   separating-axis test; boxes of more than 4x4 tiles are searched by the whole warp
//   raster_emit     a thread per kEmitItems ranks of the depth order: numbers the slots with a decoupled look-back
//                   (Merrill and Garland 2016) and writes them, in drawing order, so that a triangle's slots lie together
//   raster_ranges   a thread per slot, after they were sorted by tile: where each tile begins and ends
//   raster_order    a block per view: its tiles by their number of slots, the largest first, so that none of these is begun
//                   when all others are done
#include "cuda/raster_pass.h"

namespace etsplat {

constexpr int kProjectBlock = 128;
constexpr int kEmitBlock = 256;
constexpr int kEmitItems = 4;
constexpr int kOrderBlock = 1024;
constexpr int kSizes = 64;  // of tiles, two for each power of two

__device__ __forceinline__ bool all_finite(const float* values, int count) {
    float differences = 0.0f;  // value - value: NaN for Inf and NaN
    for (int i = 0; i < count; ++i) differences += values[i] - values[i];
    return differences == 0.0f;
}

__device__ __forceinline__ void kernel_of(const RasterPass& pass, float opacity, float sigma, float& extent,
                                          KernelCoefficients<float>& coefficients) {
    int index = 0;
#define ETSPLAT_CASE(Kernel)                                                                     \
    if (pass.kernel == index++) {                                                                \
        const Kernel kernel = kernel_with<Kernel>(pass.kernel_table);                            \
        extent = visible_extent(kernel, opacity, sigma, pass.support_alpha, pass.x_max);         \
        coefficients = kernel.coefficients(vmax(sigma, kMinSigma));                              \
    }
    ETSPLAT_KERNELS(ETSPLAT_CASE)
#undef ETSPLAT_CASE
}

struct Projected {
    TriangleRecord record;
    AttributeRecord attributes;
    float depth, screen_size, inradius;
    bool visible;
};

__device__ __forceinline__ Projected project_one(const RasterPass& pass, int m) {
    const int triangle = m % pass.triangles;
    const PinholeCamera camera = load_camera(pass, m / pass.triangles);
    Projected p;
    float opacity = pass.opacities[triangle], sigma = pass.sigmas[pass.shared_sigma ? 0 : triangle];
    const float largest = 3.402823466e38f;
    p.visible = opacity > 0.0f && opacity <= largest && sigma > 0.0f && sigma <= largest;
    if (!p.visible) opacity = sigma = 1.0f;
    float extent = 0.0f;
    KernelCoefficients<float> coefficients{0.0f, 0.0f};
    kernel_of(pass, opacity, sigma, extent, coefficients);
    float world[9], view[9];
    Triangle2D<float> t;
    p.visible = load_corners(pass, triangle, world) && p.visible;
    p.visible = project_triangle(camera, pass.near_plane, static_cast<Distance>(pass.distance), world, view, t) && p.visible;
    const DistanceForms<float> forms = distance_forms(t);
    const SupportBox<float> box = support_box(t, forms.qx, forms.qy, extent);
    p.depth = centroid_depth(view);
    p.visible = p.visible && extent > 0.0f && p.depth > 0.0f &&
                meets_image(box, forms.qx, forms.qy, pass.width, pass.height) &&
                all_finite(flat_colors_of(pass, m), pass.flat_channels) &&
                all_finite(corner_colors_of(pass, m), 3 * pass.corner_channels);
    p.screen_size = screen_size(t);
    p.inradius = inradius(t);
    p.record = {forms.qx, forms.qy, {}, {}, extent, opacity, coefficients.exponent, coefficients.scale,
                box.left, box.right, box.top, box.bottom};
    for (int k = 0; k < 3; ++k) {
        p.record.gx[k] = forms.gx[k];
        p.record.gy[k] = forms.gy[k];
        p.attributes.inverse_weight[k] = 1.0f / t.weight[k];
        p.attributes.product[k] = p.attributes.inverse_weight[k] / view[3 * k + 2];
    }
    p.attributes.centroid_z = p.depth;
    return p;
}

// The tiles of a record's box, as whole numbers, and the test that tells which of them it touches.
struct TileSearch {
    TileTest<float> test;
    int left, top, columns, rows;

    __device__ __forceinline__ TileSearch(const RasterPass& pass, const TriangleRecord& r)
        : test({r.qx, r.qy, {r.gx[0], r.gx[1], r.gx[2]}, {r.gy[0], r.gy[1], r.gy[2]}}, r.extent) {
        const TileRange<float> range({r.left, r.right, r.top, r.bottom}, r.qx, r.qy, pass.width, pass.height);
        left = static_cast<int>(range.left);
        top = static_cast<int>(range.top);
        columns = range.any ? static_cast<int>(range.right) - left + 1 : 0;
        rows = range.any ? static_cast<int>(range.bottom) - top + 1 : 0;
    }
    __device__ __forceinline__ bool small() const { return columns <= kPatternSide && rows <= kPatternSide; }
    __device__ __forceinline__ bool touches(int column, int row) const {
        return test.touches(static_cast<float>(left + column), static_cast<float>(top + row));
    }
};

// By the whole warp: calls body(tile in the view, number among the touched ones) in each lane that found one; returns how
// many there are.
template <class F>
__device__ __forceinline__ unsigned search_by_warp(const RasterPass& pass, const TileSearch& search, F&& body) {
    unsigned found = 0;
    const int total = search.columns * search.rows;
    for (int first = 0; first < total; first += kWarp) {
        const int i = first + lane_index();
        const int row = i / search.columns, column = i - row * search.columns;
        const bool touched = i < total && search.touches(column, row);
        const unsigned lanes = __ballot_sync(kAllLanes, touched);
        if (touched)
            body((search.top + row) * pass.tiles_x + search.left + column,
                 found + __popc(lanes & ((1u << lane_index()) - 1)));
        found += __popc(lanes);
    }
    return found;
}

}  // namespace etsplat

using namespace etsplat;

extern "C" __global__ void __launch_bounds__(128) raster_project(const __grid_constant__ RasterPass pass) {
    const int count = pass.views * pass.triangles, index = blockIdx.x * kProjectBlock + threadIdx.x;
    const bool inside = index < count;
    const int m = inside ? index : count - 1;
    const Projected p = project_one(pass, m);
    const bool visible = inside && p.visible;
    unsigned word = 0;
    int first = 0;
    if (visible) {
        reinterpret_cast<TriangleRecord*>(pass.records)[m] = p.record;
        if (pass.attributes) reinterpret_cast<AttributeRecord*>(pass.attributes)[m] = p.attributes;
        const TileSearch search(pass, p.record);
        first = search.top * pass.tiles_x + search.left;
        if (search.small()) {
            for (int row = 0; row < search.rows; ++row)
                for (int column = 0; column < search.columns; ++column)
                    word |= (search.touches(column, row) ? 1u : 0u) << (kPatternSide * row + column);
        } else {
            word = kMany;
        }
    }
    __syncwarp();  // the warp sees the records
    for (unsigned lanes = __ballot_sync(kAllLanes, word == kMany); lanes != 0; lanes &= lanes - 1) {
        const int lane = __ffs(static_cast<int>(lanes)) - 1;
        const TileSearch search(pass, load_record(pass, __shfl_sync(kAllLanes, m, lane)));
        const unsigned found = search_by_warp(pass, search, [](int, unsigned) {});
        if (lane_index() == lane) word = found == 0 ? 0 : kMany | found;
    }
    if (!inside) return;
    span_of(pass, m) = {static_cast<unsigned>(first), word};
    pass.depth_keys[m] = word != 0 ? __float_as_uint(p.depth) : 0x7fffffffu;  // what is nowhere goes last
    if (pass.visible) {
        pass.visible[m] = visible;
        pass.screen_size[m] = visible ? p.screen_size : 0.0f;
        pass.inradius[m] = visible ? p.inradius : 0.0f;
        pass.max_weight[m] = 0.0f;
    }
}

namespace etsplat {

// A word of the look-back: what is known of a block, above its sum.
constexpr int kKnownShift = 62;
constexpr unsigned long long kAggregate = 1, kPrefix = 2, kValueMask = (1ull << kKnownShift) - 1;

// Sum over the blocks before this one, by the first warp: 32 blocks at a time, back to one that knows its own prefix.
__device__ __forceinline__ unsigned long long look_back(volatile unsigned long long* state, int block,
                                                        unsigned long long total) {
    if (lane_index() == 0) state[block] = (kAggregate + (block == 0)) << kKnownShift | total;
    unsigned long long before = 0;
    for (int last = block - 1; last >= 0; last -= kWarp) {
        const int other = last - lane_index();
        unsigned long long word = other >= 0 ? state[other] : kPrefix << kKnownShift;
        while (__any_sync(kAllLanes, word >> kKnownShift == 0))
            if (other >= 0) word = state[other];
        const unsigned prefixes = __ballot_sync(kAllLanes, word >> kKnownShift == kPrefix);
        const int stop = prefixes != 0 ? __ffs(prefixes) - 1 : kWarp;
        before += warp_sum(lane_index() <= stop ? word & kValueMask : 0ull);
        if (prefixes != 0) break;
    }
    if (lane_index() == 0 && block > 0) state[block] = kPrefix << kKnownShift | (before + total);
    return before;
}

// A slot that does not fit is not written; then all of this is thrown away and done again with more room.
__device__ __forceinline__ void write_slot(const RasterPass& pass, unsigned long long slot, int tile, int m) {
    if (slot >= static_cast<unsigned>(pass.capacity)) return;
    pass.slot_tile[slot] = static_cast<unsigned>(m / pass.triangles * pass.tiles_x * pass.tiles_y + tile);
    pass.slot_triangle[slot] = static_cast<unsigned>(m);
    if (pass.hits) pass.hits[slot] = 0;
}

}  // namespace etsplat

extern "C" __global__ void __launch_bounds__(256) raster_emit(const __grid_constant__ RasterPass pass) {
    __shared__ unsigned warp_totals[kEmitBlock / kWarp];
    __shared__ unsigned long long block_begin;
    __shared__ int ticket;
    if (threadIdx.x == 0) ticket = static_cast<int>(atomicAdd(pass.scan_ticket, 1u));  // blocks start in this order
    __syncthreads();
    const int block = ticket, count = pass.views * pass.triangles;
    int m[kEmitItems], first[kEmitItems];
    unsigned word[kEmitItems], mine = 0;
#pragma unroll
    for (int i = 0; i < kEmitItems; ++i) {
        const int rank = (block * kEmitBlock + static_cast<int>(threadIdx.x)) * kEmitItems + i;
        m[i] = rank < count ? static_cast<int>(pass.order[rank]) : -1;
    }
#pragma unroll
    for (int i = 0; i < kEmitItems; ++i) {  // all on their way together: they lie anywhere
        const Span span = m[i] >= 0 ? span_of(pass, m[i]) : Span{0, 0};
        first[i] = static_cast<int>(span.first);
        word[i] = span.word;
        mine += span_count(word[i]);
    }
    const unsigned scanned = warp_inclusive_scan(mine);
    if (lane_index() == kWarp - 1) warp_totals[warp_index()] = scanned;
    __syncthreads();
    unsigned before = scanned - mine, total = 0;
    for (int w = 0; w < kEmitBlock / kWarp; ++w) {
        if (w < warp_index()) before += warp_totals[w];
        total += warp_totals[w];
    }
    if (warp_index() == 0) {
        const unsigned long long begin = look_back(pass.scan_state, block, total);
        if (lane_index() == 0) {
            block_begin = begin;
            if (block == static_cast<int>(gridDim.x) - 1) {
                const long long wanted = static_cast<long long>(begin + total);
                *pass.wanted = wanted;
                *pass.slots = wanted < pass.capacity ? static_cast<unsigned>(wanted) : static_cast<unsigned>(pass.capacity);
                if (pass.overflow && wanted > pass.capacity && wanted > *pass.overflow) *pass.overflow = wanted;
            }
        }
    }
    __syncthreads();
    unsigned long long slot = block_begin + before;
    for (int i = 0; i < kEmitItems; ++i) {
        const bool many = (word[i] & kMany) != 0;
        if (m[i] >= 0)
            pass.slot_begin[m[i]] =
                slot < static_cast<unsigned>(pass.capacity) ? static_cast<unsigned>(slot) : static_cast<unsigned>(pass.capacity);
        if (!many && word[i] != 0) {
            unsigned long long at = slot;
            for (unsigned bits = word[i]; bits != 0; bits &= bits - 1) {
                const int bit = __ffs(static_cast<int>(bits)) - 1;
                write_slot(pass, at++, first[i] + bit / kPatternSide * pass.tiles_x + bit % kPatternSide, m[i]);
            }
        }
        for (unsigned lanes = __ballot_sync(kAllLanes, many); lanes != 0; lanes &= lanes - 1) {
            const int lane = __ffs(static_cast<int>(lanes)) - 1;
            const int other = __shfl_sync(kAllLanes, m[i], lane);
            const unsigned long long begin = __shfl_sync(kAllLanes, slot, lane);
            const TileSearch search(pass, load_record(pass, other));
            search_by_warp(pass, search, [&](int tile, unsigned number) { write_slot(pass, begin + number, tile, other); });
        }
        slot += span_count(word[i]);
    }
}

extern "C" __global__ void raster_ranges(const __grid_constant__ RasterPass pass) {
    const unsigned i = blockIdx.x * blockDim.x + threadIdx.x, count = *pass.slots;
    if (i >= count) return;
    const unsigned tile = pass.sorted_tiles[i];
    if (i == 0 || pass.sorted_tiles[i - 1] != tile) pass.tile_ranges[2 * tile] = static_cast<int>(i);
    if (i + 1 == count || pass.sorted_tiles[i + 1] != tile) pass.tile_ranges[2 * tile + 1] = static_cast<int>(i) + 1;
}

namespace etsplat {

// Of a tile with so many slots: 0 for the largest, kSizes - 1 for none.
__device__ __forceinline__ int size_class(int slots) {
    if (slots <= 0) return kSizes - 1;
    const int power = 31 - __clz(slots), upper = power > 0 ? slots >> (power - 1) & 1 : 0;
    return kSizes - 2 - (2 * power + upper);
}

}  // namespace etsplat

extern "C" __global__ void __launch_bounds__(1024) raster_order(const __grid_constant__ RasterPass pass) {
    __shared__ unsigned begin[kSizes];
    const int t = threadIdx.x, tiles = pass.tiles_x * pass.tiles_y, base = static_cast<int>(blockIdx.x) * tiles;
    if (t < kSizes) begin[t] = 0;
    __syncthreads();
    for (int i = t; i < tiles; i += kOrderBlock) {
        const int* range = pass.tile_ranges + 2 * (base + i);
        atomicAdd(&begin[size_class(range[1] - range[0])], 1u);
    }
    __syncthreads();
    if (warp_index() == 0) {
        unsigned before = 0;
        for (int first = 0; first < kSizes; first += kWarp) {
            const unsigned here = begin[first + t], scanned = warp_inclusive_scan(here);
            begin[first + t] = before + scanned - here;
            before += __shfl_sync(kAllLanes, scanned, kWarp - 1);
        }
    }
    __syncthreads();
    for (int i = t; i < tiles; i += kOrderBlock) {
        const int* range = pass.tile_ranges + 2 * (base + i);
        pass.tile_order[base + atomicAdd(&begin[size_class(range[1] - range[0])], 1u)] = base + i;
    }
}
