// What the benchmarks count and compare with; no render calls this.
#pragma once

#include "tile_forward.h"

namespace etsplat::ETSPLAT_SIMD {

ETSPLAT_FN int count_bits(unsigned bits) {
    int count = 0;
    for_each_bit(bits, [&](int) { ++count; });
    return count;
}

// The forward pass of one tile again, by the same functions, with counters around them. A pixel is useful to a triangle
// if it is drawn: its transmittance falls.
template <class Kernel>
void count_tile(const RasterPass& pass, int index, float* scratch, TileCounts& counts) {
    const TileFrame frame(pass, index);
    ForwardTile tile;
    tile.color = scratch;
    tile.first_inverse_z = first_inverse_depth(pass, index);
    begin(tile, frame, pass.channels(), true);
    Batch batch;
    const int end = pass.tile_begin[index + 1];
    int next = pass.tile_begin[index];
    while (next < end) {
        const unsigned alive_blocks = tile.alive_blocks();
        if (alive_blocks == 0) break;
        const int count = end - next < kBatch ? end - next : kBatch;
        prepare(pass, frame, alive_blocks, pass.entries + next, count, count, batch);
        evaluate<Kernel>(pass, batch);
        for (int p = 0; p < batch.pairs.count; ++p) {
            const int block = batch.pairs.block[p];
            const Vec before = Vec::load(tile.transmittance[block]);
            draw<Shape::kGeneral>(pass, tile, batch, p);
            counts.drawn += count_bits((Vec::load(tile.transmittance[block]) < before).bits());
        }
        for (int i = 0; i < count; ++i) counts.backward_vectors += count_bits(batch.hits[i]);
        counts.forward_vectors += batch.pairs.count;
        next += count;
    }
    counts.pairs += next - pass.tile_begin[index];
}

// Tight loops over an array: the least that an evaluation of the kernel costs.
template <class Kernel>
void value_loop(const float* table, const float* x, int count, float exponent, float scale, float* out) {
    const Kernel kernel = kernel_with<Kernel>(table);
    for (int i = 0; i < count; i += kLanes)
        kernel.value(Vec::load(x + i), Vec(exponent), Vec(scale)).store(out + i);
}
template <class Kernel>
void gradient_loop(const float* table, const float* x, int count, float exponent, float scale, float* out) {
    const Kernel kernel = kernel_with<Kernel>(table);
    for (int i = 0; i < count; i += kLanes) {
        const KernelValue<Vec> g = kernel.gradient(Vec::load(x + i), Vec(exponent), Vec(scale));
        (g.value + g.dx + g.dsigma).store(out + i);
    }
}

}  // namespace etsplat::ETSPLAT_SIMD
