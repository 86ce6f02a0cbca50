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

// (triangle of the batch, block) pairs, triangle by triangle.
struct PairList {
    static constexpr int kCapacity = 16 * 16;
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
};

}  // namespace etsplat::ETSPLAT_SIMD
