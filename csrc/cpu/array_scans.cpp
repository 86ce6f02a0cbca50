#include "array_scans.h"

#include <algorithm>
#include <bit>
#include <limits>
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
IndexRange index_range(const T* values, int64_t count) {
    const auto parts = chunkwise<IndexRange>(count, [values](int64_t begin, int64_t end) {
        T low = values[begin], high = values[begin];
        for (int64_t i = begin; i < end; ++i) {
            low = std::min(low, values[i]);
            high = std::max(high, values[i]);
        }
        return IndexRange{low, high};
    });
    IndexRange total = parts.front();
    for (const IndexRange& part : parts) total = {std::min(total.low, part.low), std::max(total.high, part.high)};
    return total;
}
template IndexRange index_range(const int32_t*, int64_t);
template IndexRange index_range(const int64_t*, int64_t);

// A counting sort on one thread: 0.3 ms for the corners of 82,000 faces.
void group_indices(const int32_t* values, int64_t count, int64_t groups, int32_t* offsets, int32_t* members) {
    std::fill(offsets, offsets + groups + 1, 0);
    for (int64_t i = 0; i < count; ++i) ++offsets[values[i]];
    int32_t end = 0;
    for (int64_t g = 0; g <= groups; ++g) offsets[g] = end += offsets[g];
    // From the last to the first, so that each offset ends up where its group begins.
    for (int64_t i = count - 1; i >= 0; --i) members[--offsets[values[i]]] = static_cast<int32_t>(i);
}

void zero_floats(float* values, int64_t count) {
    parallel_for(count, kChunk, [values](int64_t begin, int64_t end) { std::fill(values + begin, values + end, 0.0f); });
}

void sum_groups(const float* values, const int32_t* offsets, const int32_t* members, int64_t groups, int64_t channels,
                float* sums) {
    parallel_for(groups, 4096, [&](int64_t begin, int64_t end) {
        for (int64_t g = begin; g < end; ++g) {
            float* sum = sums + g * channels;
            for (int64_t c = 0; c < channels; ++c) sum[c] = 0.0f;
            for (int32_t i = offsets[g]; i < offsets[g + 1]; ++i) {
                const float* row = values + members[i] * channels;
                for (int64_t c = 0; c < channels; ++c) sum[c] += row[c];
            }
        }
    });
}

}  // namespace etsplat
