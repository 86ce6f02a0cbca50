// Stage 2: visible triangles sorted by depth, then their (triangle, tile) pairs by tile, stably.
//
// Both sorts are counting sorts over chunks: each chunk counts, the counts are scanned in a fixed order, each chunk
// scatters. A stable sort has one result, so neither the number of chunks nor of threads can show.
// Slots (one per pair) are numbered triangle by triangle, so that a triangle's gradients lie together.
#include <algorithm>
#include <limits>
#include <stdexcept>
#include <utility>
#include <vector>

#include "prefetch.h"
#include "raster.h"

namespace etsplat {
namespace {

// For so many items to be counted in so many bins: what each chunk adds is its own bins, to be cleared and scanned.
int chunk_count(int64_t items, int bins) {
    return static_cast<int>(std::clamp<int64_t>(items / std::max(bins, 1024), 1, 4 * num_threads()));
}

struct Chunks {
    int64_t n;
    int count;
    int64_t begin(int c) const { return n * c / count; }
};

template <class F>
void for_chunks(const Chunks& chunks, F&& body) {
    parallel_for(chunks.count, 1, [&](int64_t first, int64_t last) {
        for (int64_t c = first; c < last; ++c)
            body(static_cast<int>(c), chunks.begin(static_cast<int>(c)), chunks.begin(static_cast<int>(c) + 1));
    });
}

// Exclusive scan of counts laid out [chunk][bin] into positions, bin-major: all chunks of bin 0, then of bin 1, ...
// Returns the total; totals of the bins go to bin_begin (bins + 1) if given.
int64_t scan_counts(int32_t* counts, int chunks, int bins, int32_t* bin_begin) {
    // groups of bins in parallel: totals of the groups first, then positions inside
    const int group_size = 512, groups = (bins + group_size - 1) / group_size;
    std::vector<int64_t> group_total(static_cast<size_t>(groups) + 1, 0);
    parallel_for(groups, 1, [&](int64_t first, int64_t last) {
        for (int64_t g = first; g < last; ++g) {
            const int b0 = static_cast<int>(g) * group_size, b1 = std::min(bins, b0 + group_size);
            int64_t total = 0;
            for (int c = 0; c < chunks; ++c)
                for (int b = b0; b < b1; ++b) total += counts[int64_t{c} * bins + b];
            group_total[static_cast<size_t>(g) + 1] = total;
        }
    });
    for (int g = 0; g < groups; ++g) group_total[static_cast<size_t>(g) + 1] += group_total[static_cast<size_t>(g)];
    parallel_for(groups, 1, [&](int64_t first, int64_t last) {
        for (int64_t g = first; g < last; ++g) {
            const int b0 = static_cast<int>(g) * group_size, b1 = std::min(bins, b0 + group_size);
            int32_t position = static_cast<int32_t>(group_total[static_cast<size_t>(g)]);
            for (int b = b0; b < b1; ++b) {
                if (bin_begin) bin_begin[b] = position;
                for (int c = 0; c < chunks; ++c) {
                    int32_t& count = counts[int64_t{c} * bins + b];
                    const int32_t n = count;
                    count = position;
                    position += n;
                }
            }
        }
    });
    const int64_t total = group_total[static_cast<size_t>(groups)];
    if (bin_begin) bin_begin[bins] = static_cast<int32_t>(total);
    return total;
}

// Numbers the slots and compacts the visible triangles, in index order. Returns the totals of all chunks.
ChunkTotals number_slots(RasterState& state, const TriangleKernels& kernels) {
    ChunkTotals total{0, 0, ~0u, 0u};
    std::vector<ChunkTotals>& chunks = state.chunk_totals;
    for (ChunkTotals& chunk : chunks) {  // pairs and triangles become those of the chunks before
        const int64_t pairs = total.pairs, triangles = total.triangles;
        total.pairs += std::exchange(chunk.pairs, pairs);
        total.triangles += std::exchange(chunk.triangles, triangles);
        total.lowest_key = std::min(total.lowest_key, chunk.lowest_key);
        total.highest_key = std::max(total.highest_key, chunk.highest_key);
    }
    if (total.pairs > std::numeric_limits<int32_t>::max())
        throw std::length_error("rasterize: more than 2^31 (triangle, tile) pairs; render fewer triangles or a smaller image");
    TrianglePass& pass = state.triangles;
    state.num_slots = total.pairs;
    state.slot_begin.resize(pass.count + 1);
    state.slot_tile.resize(total.pairs);
    state.order.resize(total.triangles);
    state.keys_swap.resize(total.triangles);
    pass.slot_begin = state.slot_begin.data();
    pass.slot_tile = state.slot_tile.data();
    pass.order = state.order.data();
    pass.ordered_keys = state.keys_swap.data();
    parallel_for(pass.count, kTriangleChunk, [&](int64_t begin, int64_t end) {
        const ChunkTotals& before = chunks[static_cast<size_t>(begin / kTriangleChunk)];
        kernels.number(state.pass, pass, begin, end, static_cast<int32_t>(before.pairs),
                       static_cast<int32_t>(before.triangles));
    });
    state.slot_begin[pass.count] = static_cast<int32_t>(total.pairs);
    state.keys.swap(state.keys_swap);
    return total;
}

// Stable radix sort of order by key. Only the bits that differ are sorted by.
void sort_by_depth(RasterState& state, const ChunkTotals& total) {
    const int64_t n = total.triangles;
    if (n < 2) return;
    const uint32_t low = total.lowest_key, range = total.highest_key - low;
    int bits = 0;
    while (bits < 32 && (range >> bits) != 0) ++bits;
    if (bits == 0) return;
    const int passes = (bits + 10) / 11, digit = (bits + passes - 1) / passes, bins = 1 << digit;
    const Chunks chunks{n, chunk_count(n, bins)};
    state.keys_swap.resize(n);
    state.order_swap.resize(n);
    state.histogram.resize(int64_t{chunks.count} * bins);
    for (int p = 0; p < passes; ++p) {
        const int shift = p * digit;
        const auto digit_of = [&](uint32_t key) { return ((key - low) >> shift) & static_cast<uint32_t>(bins - 1); };
        for_chunks(chunks, [&](int c, int64_t begin, int64_t end) {
            int32_t* counts = state.histogram.data() + int64_t{c} * bins;
            std::fill(counts, counts + bins, 0);
            for (int64_t i = begin; i < end; ++i) ++counts[digit_of(state.keys[i])];
        });
        scan_counts(state.histogram.data(), chunks.count, bins, nullptr);
        for_chunks(chunks, [&](int c, int64_t begin, int64_t end) {
            int32_t* position = state.histogram.data() + int64_t{c} * bins;
            for (int64_t i = begin; i < end; ++i) {
                const int32_t to = position[digit_of(state.keys[i])]++;
                state.keys_swap[to] = state.keys[i];
                state.order_swap[to] = state.order[i];
            }
        });
        state.keys.swap(state.keys_swap);
        state.order.swap(state.order_swap);
    }
}

// Calls body(tile, taken) for the tiles of a triangle: 1 for those it touches, 0 for the rest of its pattern. No branch
// depends on the pattern, which no processor could predict.
template <class F>
void for_each_tile(const RasterState& state, const TileSpan span, int32_t slot, F&& body) {
    const int32_t row = state.pass.tiles_x;
    if (const uint32_t pattern = span.pattern(); pattern != 0) {
        body(span.first, pattern & 1);
        body(span.first + 1, pattern >> 1 & 1);
        body(span.first + row, pattern >> 2 & 1);
        body(span.first + row + 1, pattern >> 3);
    } else {
        for (uint32_t j = 0; j < span.count(); ++j) body(state.slot_tile[slot + static_cast<int32_t>(j)], 1u);
    }
}

// In order of depth, triangles lie anywhere in memory.
void prefetch_coming(const RasterState& state, int64_t r, int64_t end) {
    const int32_t coming = state.order[std::min(r + 24, end - 1)];
    prefetch(&state.spans[coming]);
    prefetch(&state.slot_begin[coming]);
}

void sort_by_tile(RasterState& state, int64_t n) {
    const int tiles = state.pass.tiles_x * state.pass.tiles_y;
    const int bins = tiles + state.pass.tiles_x + 1;  // a pattern may reach past the last tile, with nothing there
    const Chunks chunks{n, std::min(chunk_count(state.num_slots, bins), static_cast<int>(std::max<int64_t>(n, 1)))};
    state.histogram.resize(int64_t{chunks.count} * bins);
    state.tile_begin.resize(bins + 1);
    // behind the entries each chunk has a cache line for what is not taken
    constexpr int64_t kLine = 16;
    state.entries.resize(state.num_slots + kLine * (chunks.count + 1));
    for_chunks(chunks, [&](int c, int64_t begin, int64_t end) {
        int32_t* counts = state.histogram.data() + int64_t{c} * bins;
        std::fill(counts, counts + bins, 0);
        for (int64_t r = begin; r < end; ++r) {
            const int32_t i = state.order[r];
            prefetch_coming(state, r, end);
            for_each_tile(state, state.spans[i], state.slot_begin[i],
                          [&](int32_t tile, uint32_t taken) { counts[tile] += static_cast<int32_t>(taken); });
        }
    });
    scan_counts(state.histogram.data(), chunks.count, bins, state.tile_begin.data());
    for_chunks(chunks, [&](int c, int64_t begin, int64_t end) {
        int32_t* position = state.histogram.data() + int64_t{c} * bins;
        const int64_t nowhere = state.num_slots + kLine * (c + 1);
        for (int64_t r = begin; r < end; ++r) {
            const int32_t i = state.order[r];
            prefetch_coming(state, r, end);
            int32_t slot = state.slot_begin[i];
            for_each_tile(state, state.spans[i], slot, [&](int32_t tile, uint32_t taken) {
                const int64_t to = position[tile];
                state.entries[nowhere ^ ((nowhere ^ to) & -int64_t{taken})] = {i, slot};
                position[tile] += static_cast<int32_t>(taken);
                slot += static_cast<int32_t>(taken);
            });
        }
    });
}

}  // namespace

void bin_triangles(RasterState& state, const TriangleKernels& kernels) {
    const ChunkTotals total = number_slots(state, kernels);
    sort_by_depth(state, total);
    sort_by_tile(state, total.triangles);
}

}  // namespace etsplat
