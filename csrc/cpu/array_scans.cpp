#include "array_scans.h"

#include <algorithm>
#include <bit>
#include <limits>
#include <type_traits>
#include <vector>

#include "parallel.h"

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

// Adds row i of `values` to row indices[i] of `sums` where that is from `low` to `high` - 1. Channels: 0 if not known here.
template <int Channels>
void sum_range(const float* values, const int32_t* indices, int64_t count, int64_t low, int64_t high, int64_t channels,
               float* sums) {
    if constexpr (Channels > 0) channels = Channels;
    constexpr int64_t kBlock = 1024;
    int32_t own[kBlock];  // places in the block
    const auto lowest = static_cast<uint32_t>(low), size = static_cast<uint32_t>(high - low);
    for (int64_t begin = 0; begin < count; begin += kBlock) {
        const int32_t* index = indices + begin;
        const auto places = static_cast<int32_t>(std::min(kBlock, count - begin));
        int found = 0;
        for (int32_t i = 0; i < places; ++i) {
            own[found] = i;
            found += static_cast<uint32_t>(index[i]) - lowest < size ? 1 : 0;
        }
        for (int k = 0; k < found; ++k) {
            const float* row = values + (begin + own[k]) * channels;
            float* sum = sums + index[own[k]] * channels;
            for (int64_t c = 0; c < channels; ++c) sum[c] += row[c];
        }
    }
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

// Each range of rows belongs to one thread, which looks through all indices for those of its own. For the corners of 82,000
// faces that takes 0.5 ms on one thread, where grouping them by row and gathering takes 1.1.
void sum_by_index(const float* values, const int32_t* indices, int64_t count, int64_t rows, int64_t channels, float* sums) {
    constexpr int64_t kFewest = 1 << 13;  // indices for each range
    const int64_t ranges = std::clamp<int64_t>(count / kFewest, 1, num_threads());
    const int64_t size = (rows + ranges - 1) / ranges;
    parallel_for(ranges, 1, [&](int64_t first, int64_t last) {
        const int64_t low = std::min(rows, first * size), high = std::min(rows, last * size);
        std::fill(sums + low * channels, sums + high * channels, 0.0f);
        if (channels == 3) return sum_range<3>(values, indices, count, low, high, channels, sums);
        sum_range<0>(values, indices, count, low, high, channels, sums);
    });
}

}  // namespace etsplat
