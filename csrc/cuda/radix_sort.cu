// Stable radix sort of (key, value) pairs by digits of up to 8 bits, with no round trip to the host: the number of pairs is
// read on the device, and a grid for the capacity is launched.
//
//   radix_histogram  counts every digit of every pass at once
//   radix_pass       one sweep per digit ("Onesweep", Adinets and Merrill 2022): a block ranks its pairs by warp-wide
//                    matching, learns by a decoupled look-back how many equal digits lie before it, and scatters through
//                    shared memory, so that runs of equal digits are written together. 16 bytes per pair and pass.
// `histogram`, `state` and `tickets` start at 0.
#include "cuda/common.h"

namespace etsplat {

constexpr int kDigits = 256;
constexpr int kSortBlock = 256;
constexpr int kSortWarps = kSortBlock / kWarp;
constexpr int kSortItems = 8;
constexpr int kSortTile = kSortBlock * kSortItems;
constexpr int kMostPasses = 4;
constexpr int kAhead = 8;  // blocks that the look-back looks at together
constexpr unsigned kSortAggregate = 1u << 30, kSortPrefix = 2u << 30, kSortValue = kSortAggregate - 1;

__device__ __forceinline__ unsigned digit_of(unsigned key, int shift, int bits) { return key >> shift & ((1u << bits) - 1); }

// Place among the pairs of a tile of this lane's item i: a warp has consecutive pairs, an item of all its lanes after the
// other, so ranks in that order are stable.
__device__ __forceinline__ unsigned place_of(int i) {
    return static_cast<unsigned>((warp_index() * kSortItems + i) * kWarp + lane_index());
}

// How many equal digits come before each of this lane's keys in its warp; `counts` (kDigits) of the warp start at 0 and end
// as how many there are of each. All lanes call it.
__device__ __forceinline__ void rank_in_warp(const unsigned* key, unsigned here, int shift, int bits, unsigned* counts,
                                             unsigned* rank) {
    const int lane = lane_index();
#pragma unroll
    for (int i = 0; i < kSortItems; ++i) {
        const bool inside = place_of(i) < here;
        const unsigned digit = inside ? digit_of(key[i], shift, bits) : kDigits;
        const unsigned equal = __match_any_sync(kAllLanes, digit);
        const int leader = __ffs(static_cast<int>(equal)) - 1;
        unsigned before = 0;
        if (lane == leader && inside) {
            before = counts[digit];
            counts[digit] = before + __popc(equal);
        }
        rank[i] = __shfl_sync(kAllLanes, before, leader) + __popc(equal & ((1u << lane) - 1));
        __syncwarp();
    }
}

// The decoupled look-back: how many pairs with this digit the blocks before `block` have, once they have said so. Several
// words are on their way together: blocks that start together each look back over all others, a latency after the other.
__device__ __forceinline__ unsigned pairs_before(volatile unsigned* words, int block, int digit) {
    unsigned before = 0;
    for (int other = block - 1; other >= 0;) {
        unsigned word[kAhead];
#pragma unroll
        for (int i = 0; i < kAhead; ++i) word[i] = other >= i ? words[(other - i) * kDigits + digit] : kSortPrefix;
#pragma unroll
        for (int i = 0; i < kAhead; ++i) {
            if (word[i] >> 30 == 0) break;  // not yet: from here again
            before += word[i] & kSortValue;
            if (word[i] >> 30 == 2) return before;
            --other;
        }
    }
    return before;
}

}  // namespace etsplat

using namespace etsplat;

extern "C" __global__ void __launch_bounds__(256) radix_histogram(const unsigned* keys, const unsigned* count_on_device, int count, int passes, int bits, unsigned* histogram) {
    __shared__ unsigned counts[kMostPasses * kDigits];
    for (int i = threadIdx.x; i < passes * kDigits; i += kSortBlock) counts[i] = 0;
    __syncthreads();
    const unsigned total = count_on_device ? *count_on_device : static_cast<unsigned>(count);
    for (unsigned i = blockIdx.x * kSortBlock + threadIdx.x; i < total; i += gridDim.x * kSortBlock) {
        const unsigned key = keys[i];
        for (int p = 0; p < passes; ++p) atomicAdd(&counts[p * kDigits + digit_of(key, p * bits, bits)], 1u);
    }
    __syncthreads();
    for (int i = threadIdx.x; i < passes * kDigits; i += kSortBlock)
        if (counts[i] != 0) atomicAdd(&histogram[i], counts[i]);
}

// values_in null: each pair's value is its place.
extern "C" __global__ void __launch_bounds__(256) radix_pass(const unsigned* keys_in, const unsigned* values_in, unsigned* keys_out, unsigned* values_out, const unsigned* count_on_device, int count, int shift, int bits, const unsigned* histogram, unsigned* state, unsigned* ticket_counter) {
    __shared__ unsigned warp_counts[kSortWarps][kDigits];
    __shared__ unsigned digit_begin[kDigits];   // in this block
    __shared__ unsigned digit_target[kDigits];  // in the output, less digit_begin
    __shared__ unsigned scan_totals[2][kSortWarps];
    __shared__ unsigned tile_keys[kSortTile], tile_values[kSortTile];
    __shared__ int ticket;
    const int t = threadIdx.x, warp = warp_index(), lane = lane_index();
    if (t == 0) ticket = static_cast<int>(atomicAdd(ticket_counter, 1u));
    for (int w = 0; w < kSortWarps; ++w) warp_counts[w][t] = 0;
    __syncthreads();
    const int block = ticket;
    const unsigned total = count_on_device ? *count_on_device : static_cast<unsigned>(count);
    const unsigned begin = static_cast<unsigned>(block) * kSortTile;
    if (begin >= total) return;
    const unsigned here = total - begin < kSortTile ? total - begin : kSortTile;

    // All at once, before anything that waits.
    unsigned key[kSortItems], value[kSortItems], rank[kSortItems];
#pragma unroll
    for (int i = 0; i < kSortItems; ++i) {
        const unsigned at = place_of(i);
        key[i] = at < here ? keys_in[begin + at] : 0;
        value[i] = at < here && values_in ? values_in[begin + at] : begin + at;
    }
    rank_in_warp(key, here, shift, bits, warp_counts[warp], rank);
    __syncthreads();

    // A thread per digit: its pairs in this block, then in the blocks before, then those of smaller digits.
    unsigned count_here = 0;
    for (int w = 0; w < kSortWarps; ++w) {
        const unsigned in_warp = warp_counts[w][t];
        warp_counts[w][t] = count_here;
        count_here += in_warp;
    }
    volatile unsigned* words = state;
    words[block * kDigits + t] = (block == 0 ? kSortPrefix : kSortAggregate) | count_here;
    const unsigned everywhere = histogram[t];
    const unsigned scan_here = warp_inclusive_scan(count_here), scan_all = warp_inclusive_scan(everywhere);
    if (lane == kWarp - 1) {
        scan_totals[0][warp] = scan_here;
        scan_totals[1][warp] = scan_all;
    }
    __syncthreads();
    unsigned smaller_here = scan_here - count_here, target = scan_all - everywhere;
    for (int w = 0; w < warp; ++w) {
        smaller_here += scan_totals[0][w];
        target += scan_totals[1][w];
    }
    const unsigned before_block = pairs_before(words, block, t);
    if (block > 0) words[block * kDigits + t] = kSortPrefix | (before_block + count_here);
    digit_begin[t] = smaller_here;
    digit_target[t] = target + before_block - smaller_here;
    __syncthreads();

#pragma unroll
    for (int i = 0; i < kSortItems; ++i) {
        if (place_of(i) >= here) continue;
        const unsigned digit = digit_of(key[i], shift, bits);
        const unsigned place = digit_begin[digit] + warp_counts[warp][digit] + rank[i];
        tile_keys[place] = key[i];
        tile_values[place] = value[i];
    }
    __syncthreads();
    for (unsigned place = t; place < here; place += kSortBlock) {
        const unsigned k = tile_keys[place];
        const unsigned to = digit_target[digit_of(k, shift, bits)] + place;
        keys_out[to] = k;
        values_out[to] = tile_values[place];
    }
}
