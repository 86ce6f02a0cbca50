#include "array_scans.h"

#include <algorithm>
#include <bit>
#include <limits>
#include <memory>
#include <type_traits>
#include <utility>
#include <vector>

#include "parallel.h"
#include "pool.h"
#include "prefetch.h"

namespace etsplat {
namespace {

constexpr int64_t kChunk = int64_t{1} << 15;
constexpr int32_t kInfinity = 0x7f800000;   // its bits
constexpr int32_t kMagnitude = 0x7fffffff;  // all bits but the sign, in the order of the magnitudes

template <class Part, class F>
std::vector<Part> chunkwise(int64_t count, F&& scan) {
    std::vector<Part> parts(static_cast<size_t>((count + kChunk - 1) / kChunk));
    parallel_for(static_cast<int64_t>(parts.size()), 1, [&](int64_t first, int64_t last) {
        for (int64_t c = first; c < last; ++c)
            parts[static_cast<size_t>(c)] = scan(c * kChunk, std::min(count, (c + 1) * kChunk));
    });
    return parts;
}

// Bits of a float to an integer of the same order, and back.
int32_t in_order(int32_t bits) { return bits ^ ((bits >> 31) & kMagnitude); }

// Adds rows of `values` to those of `sums` that they belong to: `count` of them, in the order of place(0), place(1), ...
// Channels: 0 if not known here.
template <int Channels, class Place>
void add_rows(const float* values, const int32_t* indices, int64_t count, int64_t channels, float* sums, Place place) {
    if constexpr (Channels > 0) channels = Channels;
    constexpr int64_t kAhead = 24;
    for (int64_t k = 0; k < count; ++k) {
        prefetch(sums + indices[place(k + kAhead < count ? k + kAhead : k)] * channels);
        const int64_t i = place(k);
        const float* row = values + i * channels;
        float* sum = sums + indices[i] * channels;
        for (int64_t c = 0; c < channels; ++c) sum[c] += row[c];
    }
}

template <class Place>
void add_rows(const float* values, const int32_t* indices, int64_t count, int64_t channels, float* sums, Place place) {
    if (channels == 3) return add_rows<3>(values, indices, count, channels, sums, place);
    add_rows<0>(values, indices, count, channels, sums, place);
}

// Lists the places of a chunk of indices by their ranges, each of 2^shift rows: those of range r from ends[r - 1] to ends[r].
void list_by_range(const int32_t* indices, int64_t count, int shift, int64_t ranges, int32_t* ends, uint16_t* places) {
    std::fill(ends, ends + ranges, 0);
    for (int64_t i = 0; i < count; ++i) ++ends[indices[i] >> shift];
    int32_t total = 0;
    for (int64_t r = 0; r < ranges; ++r) ends[r] = std::exchange(total, total + ends[r]);
    for (int64_t i = 0; i < count; ++i) places[ends[indices[i] >> shift]++] = static_cast<uint16_t>(i);
}

}  // namespace

FloatScan scan_floats(const float* values, int64_t count, float largest) {
    const int32_t most = std::bit_cast<int32_t>(std::min(largest, std::numeric_limits<float>::max()));
    const auto parts = chunkwise<FloatScan>(count, [values, most](int64_t begin, int64_t end) {
        // On integers in the order of the floats, which the compiler may reorder and so vectorise
        int32_t unusable = 0, lowest = kInfinity;
        for (int64_t i = begin; i < end; ++i) {
            const int32_t bits = std::bit_cast<int32_t>(values[i]);
            const bool usable = (bits & kMagnitude) <= most;
            const int32_t ordered = usable ? in_order(bits) : kInfinity;
            unusable += usable ? 0 : 1;
            lowest = ordered < lowest ? ordered : lowest;
        }
        return FloatScan{unusable, std::bit_cast<float>(in_order(lowest))};
    });
    FloatScan total{0, std::numeric_limits<float>::infinity()};
    for (const FloatScan& part : parts) {
        total.unusable += part.unusable;
        total.minimum = std::min(total.minimum, part.minimum);
    }
    return total;
}

template <class T>
bool indices_below(const T* values, int64_t count, int64_t bound) {
    using Bits = std::make_unsigned_t<T>;
    const auto last = static_cast<Bits>(std::min<int64_t>(bound - 1, std::numeric_limits<T>::max()));
    const auto parts = chunkwise<Bits>(count, [values, last](int64_t begin, int64_t end) {
        Bits wrong = 0;  // the sign bit: of a negative index, or of what one lacks that is too large
        for (int64_t i = begin; i < end; ++i) wrong |= static_cast<Bits>(values[i]) | (last - static_cast<Bits>(values[i]));
        return wrong;
    });
    return std::ranges::all_of(parts, [](Bits wrong) { return static_cast<T>(wrong) >= 0; });
}
template bool indices_below(const int32_t*, int64_t, int64_t);
template bool indices_below(const int64_t*, int64_t, int64_t);

template <class T>
void copy_indices(const T* values, int64_t count, int32_t* copies) {
    parallel_for(count, kChunk, [=](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) copies[i] = static_cast<int32_t>(values[i]);
    });
}
template void copy_indices(const int32_t*, int64_t, int32_t*);
template void copy_indices(const int64_t*, int64_t, int32_t*);

bool are_intrinsics(const float* Ks, int64_t count) {
    for (const float* K = Ks; K < Ks + 9 * count; K += 9)
        if (K[1] != 0.0f || K[3] != 0.0f || K[6] != 0.0f || K[7] != 0.0f || K[8] != 1.0f) return false;
    return true;
}

void zero_floats(float* values, int64_t count) {
    parallel_for(count, kChunk, [values](int64_t begin, int64_t end) { std::fill(values + begin, values + end, 0.0f); });
}

void add_by_index(const float* values, const int32_t* indices, int64_t count, int64_t channels, float* sums) {
    add_rows(values, indices, count, channels, sums, [](int64_t k) { return k; });
}

// One thread goes from the first row to the last. Many first list for each chunk of rows which belong to which range of
// sums, then each adds to ranges of its own, chunk by chunk: the same order for every sum. That is four times the work.
void sum_by_index(const float* values, const int32_t* indices, int64_t count, int64_t rows, int64_t channels, float* sums) {
    constexpr int64_t kListed = int64_t{1} << 13;  // rows of a chunk
    if (num_threads() <= 4 || count < 2 * kListed) {
        std::fill(sums, sums + rows * channels, 0.0f);
        return add_by_index(values, indices, count, channels, sums);
    }
    int shift = 0;
    while ((rows >> shift) >= 4 * num_threads()) ++shift;
    const int64_t ranges = (rows >> shift) + 1, chunks = (count + kListed - 1) / kListed;
    std::vector<int32_t> ends(static_cast<size_t>(chunks * ranges));
    const std::unique_ptr<float, void (*)(float*)> block(pool_acquire(static_cast<size_t>(count + 1) / 2), pool_release);
    auto* const places = reinterpret_cast<uint16_t*>(block.get());
    parallel_for(chunks, 1, [&](int64_t first, int64_t last) {
        for (int64_t c = first, at = c * kListed; c < last; ++c, at += kListed)
            list_by_range(indices + at, std::min(kListed, count - at), shift, ranges, ends.data() + c * ranges, places + at);
    });
    parallel_for(ranges, 1, [&](int64_t first, int64_t last) {
        for (int64_t r = first; r < last; ++r) {
            std::fill(sums + (r << shift) * channels, sums + std::min(rows, (r + 1) << shift) * channels, 0.0f);
            for (int64_t c = 0, at = 0; c < chunks; ++c, at += kListed) {
                const int32_t* end = ends.data() + c * ranges + r;
                const int32_t begin = r > 0 ? end[-1] : 0;
                const uint16_t* listed = places + at + begin;
                add_rows(values + at * channels, indices + at, *end - begin, channels, sums,
                         [listed](int64_t k) { return int64_t{listed[k]}; });
            }
        }
    });
}

void gather_rows(const float* values, const int32_t* indices, int64_t count, int64_t channels, float* rows) {
    parallel_for(count, kChunk, [=](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) {
            const float* value = values + indices[i] * channels;
            if (channels == 3)
                std::copy(value, value + 3, rows + 3 * i);
            else
                std::copy(value, value + channels, rows + channels * i);
        }
    });
}

}  // namespace etsplat
