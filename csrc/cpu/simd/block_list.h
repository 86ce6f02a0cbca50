// Lists the set bits of 16-bit block masks without a branch per bit: two table look-ups of eight bits each.
#pragma once

#include <stdint.h>
#include <string.h>

#include "pack.h"

namespace etsplat::ETSPLAT_SIMD {

struct BitTable {
    uint8_t positions[256][8];
    uint8_t count[256];

    constexpr BitTable() : positions(), count() {
        for (int bits = 0; bits < 256; ++bits)
            for (int i = 0; i < 8; ++i)
                if (bits >> i & 1) positions[bits][count[bits]++] = static_cast<uint8_t>(i);
    }
};
constexpr BitTable kBitTable{};

constexpr int kBatch = 16;  // triangles at most

// (triangle of the batch, block) pairs, triangle by triangle.
struct PairList {
    static constexpr int kCapacity = kBatch * 16;
    uint8_t triangle[kCapacity + 16];
    uint8_t block[kCapacity + 16];
    int count;

    ETSPLAT_FN void clear() { count = 0; }
    ETSPLAT_FN void append(int index, unsigned blocks) {
        const unsigned low = blocks & 255u, high = blocks >> 8;
        memset(triangle + count, index, 16);
        memcpy(block + count, kBitTable.positions[low], 8);
        const int middle = count + kBitTable.count[low];
        for (int i = 0; i < 8; ++i) block[middle + i] = static_cast<uint8_t>(kBitTable.positions[high][i] + 8);
        count = middle + kBitTable.count[high];
    }
    // Repeats the last pair behind the end, so that pairs can be taken kTogether at a time.
    ETSPLAT_FN void pad() {
        for (int i = 0; i < kTogether - 1 && count > 0; ++i) {
            triangle[count + i] = triangle[count + i - 1];
            block[count + i] = block[count + i - 1];
        }
    }
};

}  // namespace etsplat::ETSPLAT_SIMD
