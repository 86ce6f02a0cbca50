// Front-to-back compositing of one tile (paper, equation 1).
//
// Triangles come in batches. For each, one vector test over the 16 blocks finds those it can touch; the (triangle, block)
// pairs of the batch are listed, and each is one vector of 16 pixels. First the kernel is evaluated for all of them, then
// they are drawn in order. A kernel is a chain of some 150 cycles, longer than what a processor looks ahead, so several
// vectors go through it side by side (Wide), which is possible because nothing in it depends on other triangles: dead
// pixels are masked when they are drawn, and dead blocks drop out between batches only. The list keeps the loops
// free of branches that depend on what was just computed.
// Colour and transmittance of the tile stay in the first-level cache.
#pragma once

#include <bit>

#include "block_list.h"
#include "tile.h"

namespace etsplat::ETSPLAT_SIMD {

// Per-pixel state of a tile during the forward pass, in blocks of 16 lanes.
struct ForwardTile {
    float transmittance[kBlocks][16];
    float weighted_depth[kBlocks][16];   // sum w m and sum w m^2 of the distortion
    float weighted_square[kBlocks][16];
    float distortion[kBlocks][16];
    float median[kBlocks][16];  // bits of an int32: 1 + triangle at which T falls to one half, 0 if none
    uint16_t alive[kBlocks];
    float first_inverse_z;
    float* color;  // [channel][block][16]

    ETSPLAT_FN unsigned alive_blocks() const {
        unsigned blocks = 0;
        for (int block = 0; block < kBlocks; ++block) blocks |= any_bit(alive[block]) << block;
        return blocks;
    }

    ETSPLAT_FN float* channel(int c, int block) { return color + (c * kBlocks + block) * 16; }
};

ETSPLAT_FN void begin(ForwardTile& tile, const TileFrame& frame, int channels, bool general) {
    for (int block = 0; block < kBlocks; ++block) {
        Vec(1.0f).store(tile.transmittance[block]);
        tile.alive[block] = static_cast<uint16_t>(frame.whole() ? 0xffffu : frame.inside(block));
        for (int c = 0; c < channels; ++c) Vec(0.0f).store(tile.channel(c, block));
        if (general) {
            Vec(0.0f).store(tile.weighted_depth[block]);
            Vec(0.0f).store(tile.weighted_square[block]);
            Vec(0.0f).store(tile.distortion[block]);
            Vec(0.0f).store(tile.median[block]);
        }
    }
}

// Interpolated channels, and in the general pass distortion and median triangle, of the pixels of one block, drawn with
// weights w (0 elsewhere).
template <Shape kShape>
ETSPLAT_FN void draw_extras(const RasterPass& pass, ForwardTile& tile, const Vec form[3], int triangle, int block,
                            Vec transmittance, Vec w) {
    constexpr bool kGeneral = kShape == Shape::kGeneral;
    const VecMask drawn = w > Vec(0.0f);
    if (kGeneral && pass.want_median) {
        const VecMask crosses = drawn & (transmittance > Vec(0.5f)) & (transmittance - w <= Vec(0.5f));
        const Vec bits(std::bit_cast<float>(triangle + 1));  // moved about, never computed with
        vselect(crosses, bits, Vec::load(tile.median[block])).store(tile.median[block]);
    }
    if (kGeneral && !pass.attributes && !pass.want_distortion) return;
    const AttributeRecord& record = pass.attribute_records[triangle];
    Interpolation<Vec> at;
    Vec z(record.centroid_z);
    if (!kGeneral || pass.attributes) {
        const int flat = kGeneral ? pass.flat_channels : 0, channels = kGeneral ? pass.corner_channels : kFastChannels;
        const float* corners = pass.corner_colors + int64_t{3} * triangle * channels;
        at.evaluate(record, form);
        if (kGeneral && pass.distortion_depth == DistortionDepth::kPlane) z = at.depth();
        for (int c = 0; c < channels; ++c) {
            const float* color = corners + c;
            float* out = tile.channel(flat + c, block);
            const Vec value = at.mean(Vec(color[0]), Vec(color[channels]), Vec(color[2 * channels]));
            vfma(w, value, Vec::load(out)).store(out);
        }
    }
    if (kGeneral && pass.want_distortion) {
        const Vec m = distortion_coordinate(pass.distortion_near, pass.distortion_far, tile.first_inverse_z, Vec(1.0f) / z);
        const Vec wm = keep(drawn, w * m);
        const Vec first = Vec::load(tile.weighted_depth[block]), second = Vec::load(tile.weighted_square[block]);
        const Vec accumulated = Vec(1.0f) - transmittance;
        const Vec spread = distortion_spread(m, accumulated, first, second);
        (Vec::load(tile.distortion[block]) + keep(drawn, w * spread)).store(tile.distortion[block]);
        (first + wm).store(tile.weighted_depth[block]);
        (second + keep(drawn, wm * m)).store(tile.weighted_square[block]);
    }
}

struct Batch {
    TriangleForms forms[kBatch];
    Vec largest_weight[kBatch];
    TileEntry entries[kBatch];
    unsigned hits[kBatch];
    PairList pairs;
    float alpha[PairList::kCapacity + kTogether][16];  // of each pair
    uint16_t visible[PairList::kCapacity + kTogether];  // lanes within the extent, with enough alpha
};

ETSPLAT_FN void prepare(const RasterPass& pass, const TileFrame& frame, unsigned alive_blocks, const TileEntry* entries,
                        int count, int ahead, Batch& batch) {
    batch.pairs.clear();
    // the records of the next batch, maybe of the next tile, are on their way while this one is drawn
    for (int i = count; i < ahead; ++i) prefetch_triangle(pass, entries[i].triangle);
    for (int i = 0; i < count; ++i) {
        const TriangleRecord& record = pass.records[entries[i].triangle];
        batch.entries[i] = entries[i];
        batch.hits[i] = 0;
        batch.largest_weight[i] = Vec(0.0f);
        batch.forms[i].prepare(record, frame);
        batch.pairs.append(i, batch.forms[i].blocks(record) & alive_blocks);
    }
}

// Alpha of all pairs.
template <class Kernel>
ETSPLAT_FN void evaluate(const RasterPass& pass, Batch& batch) {
    const Kernel kernel = kernel_with<Kernel>(pass.kernel_table);
    batch.pairs.pad();
    for (int p = 0; p < batch.pairs.count; p += kTogether) {
        Wide x, exponent, scale, opacity, extent;
        for (int j = 0; j < kTogether; ++j) {
            const int i = batch.pairs.triangle[p + j];
            const TriangleRecord& record = pass.records[batch.entries[i].triangle];
            put(x, j, batch.forms[i].distance(batch.pairs.block[p + j]));
            put(exponent, j, Vec(record.exponent));
            put(scale, j, Vec(record.scale));
            put(opacity, j, Vec(record.opacity));
            put(extent, j, Vec(record.extent));
        }
        const Wide alpha = vmin(opacity * kernel.value(x, exponent, scale), Wide(pass.alpha_max));
        const WideMask visible = (x <= extent) & (alpha >= Wide(pass.alpha_min));
        for (int j = 0; j < kTogether; ++j) {
            vector_of(alpha, j).store(batch.alpha[p + j]);
            batch.visible[p + j] = static_cast<uint16_t>(vector_of(visible, j).bits());
        }
    }
}

// Draws a pair: one triangle over one block.
template <Shape kShape>
ETSPLAT_FN void draw(const RasterPass& pass, ForwardTile& tile, Batch& batch, int pair) {
    const int i = batch.pairs.triangle[pair], block = batch.pairs.block[pair];
    const int triangle = batch.entries[i].triangle;
    const int flat = flat_channels<kShape>(pass);
    const float* color = pass.flat_colors + int64_t{triangle} * flat;

    const Vec alpha = Vec::load(batch.alpha[pair]);
    const Vec transmittance = Vec::load(tile.transmittance[block]);
    const unsigned alive = tile.alive[block];
    const VecMask mask = VecMask::from_bits(alive & batch.visible[pair]);
    const Vec all = alpha * transmittance, rest = transmittance - all, transmittance_min(pass.transmittance_min);
    // two comparisons, so that the next triangle need not wait for masks that become bits and masks again
    const VecMask stop = mask & (rest < transmittance_min), drawn = mask & (rest >= transmittance_min);
    const Vec w = keep(drawn, all);
    vselect(drawn, rest, transmittance).store(tile.transmittance[block]);
    tile.alive[block] = static_cast<uint16_t>(alive & ~stop.bits());
    batch.hits[i] |= any_bit(mask.bits()) << block;
    for (int c = 0; c < flat; ++c) {
        float* out = tile.channel(c, block);
        vfma(w, Vec(color[c]), Vec::load(out)).store(out);
    }
    if (pass.slot_weight) batch.largest_weight[i] = vmax(batch.largest_weight[i], w);
    if constexpr (kShape != Shape::kFlat) {
        const TriangleForms& forms = batch.forms[i];
        const Vec form[3] = {forms.value(0, block), forms.value(1, block), forms.value(2, block)};
        draw_extras<kShape>(pass, tile, form, triangle, block, transmittance, w);
    }
}

// Whole tiles of the fast pass, a row of pixels at a time.
ETSPLAT_FN void finish_rows(const RasterPass& pass, ForwardTile& tile, const TileFrame& frame) {
    Vec background[3];
    for (int c = 0; c < 3; ++c) background[c] = Vec(pass.background ? pass.background[c] : 0.0f);
    for (int row = 0; row < kTile; ++row) {
        const int64_t pixel = static_cast<int64_t>(frame.y0 + row) * pass.width + frame.x0;
        const Vec t = load_row(tile.transmittance[0], row);
        Vec color[3];
        for (int c = 0; c < 3; ++c) color[c] = vfma(t, background[c], load_row(tile.channel(c, 0), row));
        interleave3(color, pass.color + 3 * pixel);
        (Vec(1.0f) - t).store(pass.alpha + pixel);
    }
}

ETSPLAT_FN void finish(const RasterPass& pass, ForwardTile& tile, const TileFrame& frame) {
    const int channels = pass.channels();
    for (int block = 0; block < kBlocks; ++block) {
        const int columns = frame.column_count(block);
        for (int row = 0; row < frame.row_count(block); ++row) {
            const int64_t pixel = frame.pixel(block, row, pass.width);
            const float* t = tile.transmittance[block] + 4 * row;
            float* out = pass.color + pixel * channels;
            for (int c = 0; c < channels; ++c) {
                const float* in = tile.channel(c, block) + 4 * row;
                const float background = pass.background ? pass.background[c] : 0.0f;
                for (int i = 0; i < columns; ++i) out[i * channels + c] = in[i] + t[i] * background;
            }
            for (int i = 0; i < columns; ++i) pass.alpha[pixel + i] = 1.0f - t[i];
            if (pass.want_median)
                for (int i = 0; i < columns; ++i)
                    pass.median_triangle[pixel + i] = std::bit_cast<int32_t>(tile.median[block][4 * row + i]);
            if (pass.want_distortion)
                for (int i = 0; i < columns; ++i) {
                    pass.distortion[pixel + i] = tile.distortion[block][4 * row + i];
                    pass.distortion_totals[2 * (pixel + i)] = tile.weighted_depth[block][4 * row + i];
                    pass.distortion_totals[2 * (pixel + i) + 1] = tile.weighted_square[block][4 * row + i];
                }
        }
    }
}

template <class Kernel, Shape kShape>
void forward_tile(const RasterPass& pass, int index, float* scratch) {
    const TileFrame frame(pass, index);
    ForwardTile tile;
    tile.color = scratch;
    constexpr bool kGeneral = kShape == Shape::kGeneral;
    if constexpr (kGeneral) tile.first_inverse_z = first_inverse_depth(pass, index);
    begin(tile, frame, pass.channels(), kGeneral);
    Batch batch;
    const int end = pass.tile_begin[index + 1], all = entry_count(pass);
    int next = pass.tile_begin[index];
    while (next < end) {
        const unsigned alive_blocks = tile.alive_blocks();
        if (alive_blocks == 0) break;
        const int count = end - next < kBatch ? end - next : kBatch;
        const int ahead = all - next < count + kBatch ? all - next : count + kBatch;
        prepare(pass, frame, alive_blocks, pass.entries + next, count, ahead, batch);
        evaluate<Kernel>(pass, batch);
        for (int p = 0; p < batch.pairs.count; ++p) draw<kShape>(pass, tile, batch, p);
        for (int i = 0; i < count; ++i) {
            if (pass.hits) pass.hits[batch.entries[i].slot] = static_cast<uint16_t>(batch.hits[i]);
            if (pass.slot_weight) pass.slot_weight[batch.entries[i].slot] = lane_max(batch.largest_weight[i]);
        }
        next += count;
    }
    if (pass.tile_done) pass.tile_done[index] = next;
    if (!kGeneral && frame.whole())
        finish_rows(pass, tile, frame);
    else
        finish(pass, tile, frame);
}

}  // namespace etsplat::ETSPLAT_SIMD
