// What the backward pass needs of the kernel, evaluated for some triangles of a tile before any of them is differentiated: as in
// the forward pass (tile_forward.h), several vectors go side by side through what depends on no other triangle.
#pragma once

#include "block_list.h"
#include "tile.h"

namespace etsplat::ETSPLAT_SIMD {

// Of a (triangle, block) pair, in lanes.
struct PairGradient {
    float value[16];     // G
    float dsigma[16];    // dG/dsigma
    float slope[3][16];  // dG/dx, in the place of the form that x is; 0 in the others
};

struct BackwardBatch {
    static constexpr int kEnough = 32;  // pairs; few, so that their gradients stay in the first-level cache
    static constexpr int kPairs = kEnough - 1 + kBlocks;

    TriangleForms forms[kBatch];
    TileEntry entries[kBatch];
    int begin[kBatch + 1];  // of each triangle's pairs
    int count;              // of triangles
    PairList pairs;
    PairGradient gradients[kPairs + kTogether];
    uint16_t visible[kPairs + kTogether];  // lanes within the extent, with enough alpha
};

// Takes entries from `next` on that the forward pass drew, and returns where the next batch begins. Their slots, which lie
// anywhere in memory, are on their way while kernels are evaluated. Behind `end` those of the next tile are asked for.
ETSPLAT_FN int collect(const RasterPass& pass, const TileFrame& frame, int next, int end, int next_tile, BackwardBatch& batch) {
    constexpr int kAhead = 16;
    const int last = entry_count(pass) - 1, stride = pass.slot_layout.stride();
    batch.pairs.clear();
    batch.count = 0;
    while (next < end && batch.count < kBatch && batch.pairs.count < BackwardBatch::kEnough) {
        const int ahead = next + kAhead < end ? next + kAhead : next + kAhead - end + next_tile;
        const TileEntry& coming = pass.entries[ahead < last ? ahead : last];
        prefetch_triangle(pass, coming.triangle);
        prefetch(pass.hits + coming.slot);
        const TileEntry entry = pass.entries[next++];
        const unsigned blocks = pass.hits[entry.slot];
        if (blocks == 0) continue;
        const int i = batch.count++;
        batch.entries[i] = entry;
        for (int line = 0; line < stride; line += 16) prefetch(pass.slots + int64_t{entry.slot} * stride + line);
        batch.begin[i] = batch.pairs.count;
        batch.forms[i].prepare(pass.records[entry.triangle], frame);
        batch.pairs.append(i, blocks);
    }
    batch.begin[batch.count] = batch.pairs.count;
    return next;
}

template <class Kernel>
ETSPLAT_FN void evaluate(const RasterPass& pass, BackwardBatch& batch) {
    const Kernel kernel = kernel_with<Kernel>(pass.kernel_table);
    batch.pairs.pad();
    for (int p = 0; p < batch.pairs.count; p += kTogether) {
        Wide form[3], exponent, scale, opacity, extent;
        for (int j = 0; j < kTogether; ++j) {
            const int i = batch.pairs.triangle[p + j];
            const TriangleRecord& record = pass.records[batch.entries[i].triangle];
            for (int k = 0; k < 3; ++k) put(form[k], j, batch.forms[i].value(k, batch.pairs.block[p + j]));
            put(exponent, j, Vec(record.exponent));
            put(scale, j, Vec(record.scale));
            put(opacity, j, Vec(record.opacity));
            put(extent, j, Vec(record.extent));
        }
        const Wide x = vmax(form[0], vmax(form[1], form[2])), none(0.0f);
        const KernelValue<Wide> gain = kernel.gradient(x, exponent, scale);
        const Wide alpha = vmin(opacity * gain.value, Wide(pass.alpha_max));
        const WideMask visible = (x <= extent) & (alpha >= Wide(pass.alpha_min));
        const WideMask first = form[0] >= x, second = and_not(form[1] >= x, first);
        const Wide slope[3] = {keep(first, gain.dx), keep(second, gain.dx), vselect(first | second, none, gain.dx)};
        for (int j = 0; j < kTogether; ++j) {
            PairGradient& out = batch.gradients[p + j];
            vector_of(gain.value, j).store(out.value);
            vector_of(gain.dsigma, j).store(out.dsigma);
            for (int k = 0; k < 3; ++k) vector_of(slope[k], j).store(out.slope[k]);
            batch.visible[p + j] = static_cast<uint16_t>(vector_of(visible, j).bits());
        }
    }
}

}  // namespace etsplat::ETSPLAT_SIMD
