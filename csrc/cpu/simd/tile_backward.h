// Gradients of one tile, front to back with one running scalar per pixel.
//
// S starts as everything the pixel's cotangents see behind the first triangle, <g, C with background> - g_A T_N
// (+ 2 g_D D), and loses each triangle's share as it passes:  dL/dalpha_k = T_k (cotangent of k) - S_k / (1 - alpha_k).
// Blocks are the ones the forward pass recorded. Sums over pixels are kept per (triangle, tile) in a slot of their own,
// one or more whole cache lines, and added up per triangle afterwards in a fixed order: no atomics, and the same bits
// for any number of threads.
#pragma once

#include "backward_batch.h"

namespace etsplat::ETSPLAT_SIMD {

struct BackwardTile {
    float transmittance[kBlocks][16];
    float remaining[kBlocks][16];  // S
    float grad_distortion[kBlocks][16];
    float total_first[kBlocks][16];   // sum w m, sum w m^2, sum w over the whole ray
    float total_second[kBlocks][16];
    float total_weight[kBlocks][16];
    uint16_t alive[kBlocks];
    float first_inverse_z;
    float* grad_color;  // [channel][block][16]
    float* sums;        // lanes of the sums of a slot, general pass only

    ETSPLAT_FN const float* channel(int c, int block) const { return grad_color + (c * kBlocks + block) * 16; }
};

ETSPLAT_FN void load_block(const RasterPass& pass, BackwardTile& tile, const TileFrame& frame, int block) {
    const int channels = pass.channels(), columns = frame.column_count(block);
    float* remaining = tile.remaining[block];
    if (!frame.whole()) {
        Vec(0.0f).store(remaining);
        for (int c = 0; c < channels; ++c) Vec(0.0f).store(tile.grad_color + (c * kBlocks + block) * 16);
    }
    for (int row = 0; row < frame.row_count(block); ++row) {
        const int64_t pixel = frame.pixel(block, row, pass.width);
        const float* color = pass.color + pixel * channels;
        const float* grad = pass.grad_color + pixel * channels;
        for (int i = 0; i < columns; ++i) remaining[4 * row + i] = 0.0f;
        for (int c = 0; c < channels; ++c) {
            float* out = tile.grad_color + (c * kBlocks + block) * 16 + 4 * row;
            for (int i = 0; i < columns; ++i) {
                out[i] = grad[i * channels + c];
                remaining[4 * row + i] += out[i] * color[i * channels + c];
            }
        }
        if (pass.grad_alpha)
            for (int i = 0; i < columns; ++i)
                remaining[4 * row + i] -= pass.grad_alpha[pixel + i] * (1.0f - pass.alpha[pixel + i]);
    }
}

// Whole tiles of the fast pass, a row of pixels at a time.
ETSPLAT_FN void load_rows(const RasterPass& pass, BackwardTile& tile, const TileFrame& frame) {
    for (int row = 0; row < kTile; ++row) {
        const int64_t pixel = static_cast<int64_t>(frame.y0 + row) * pass.width + frame.x0;
        Vec color[3], grad[3];
        deinterleave3(pass.color + 3 * pixel, color);
        deinterleave3(pass.grad_color + 3 * pixel, grad);
        Vec remaining = color[0] * grad[0];
        for (int c = 0; c < 3; ++c) {
            if (c > 0) remaining = vfma(color[c], grad[c], remaining);
            store_row(tile.grad_color + c * kBlocks * 16, row, grad[c]);
        }
        if (pass.grad_alpha)
            remaining = remaining - Vec::load(pass.grad_alpha + pixel) * (Vec(1.0f) - Vec::load(pass.alpha + pixel));
        store_row(tile.remaining[0], row, remaining);
    }
}

ETSPLAT_FN void load_distortion(const RasterPass& pass, BackwardTile& tile, const TileFrame& frame, int block) {
    Vec(0.0f).store(tile.grad_distortion[block]);
    const int columns = frame.column_count(block);
    for (int row = 0; row < frame.row_count(block); ++row) {
        const int64_t pixel = frame.pixel(block, row, pass.width);
        for (int i = 0; i < columns; ++i) {
            const int lane = 4 * row + i;
            tile.grad_distortion[block][lane] = pass.grad_distortion[pixel + i];
            tile.total_first[block][lane] = pass.distortion_totals[2 * (pixel + i)];
            tile.total_second[block][lane] = pass.distortion_totals[2 * (pixel + i) + 1];
            tile.total_weight[block][lane] = pass.alpha[pixel + i];
            tile.remaining[block][lane] += 2.0f * pass.grad_distortion[pixel + i] * pass.distortion[pixel + i];
        }
    }
}

ETSPLAT_FN void begin(const RasterPass& pass, BackwardTile& tile, const TileFrame& frame, bool general) {
    const bool rows = !general && frame.whole();
    if (rows) load_rows(pass, tile, frame);
    for (int block = 0; block < kBlocks; ++block) {
        tile.alive[block] = static_cast<uint16_t>(frame.whole() ? 0xffffu : frame.inside(block));
        Vec(1.0f).store(tile.transmittance[block]);
        if (!rows) load_block(pass, tile, frame, block);
        if (pass.grad_distortion) load_distortion(pass, tile, frame, block);
    }
}

// Asks for the pixels of a tile while the one before it is differentiated: its rows lie too far apart to be foreseen.
ETSPLAT_FN void prefetch_images(const RasterPass& pass, int index) {
    if (index >= pass.tiles_x * pass.tiles_y || pass.tile_begin[index] == pass.tile_done[index]) return;
    const TileFrame frame(pass, index);
    const int channels = pass.channels();
    for (int row = 0; row < frame.rows; ++row) {
        const int64_t first = (int64_t{frame.y0 + row} * pass.width + frame.x0) * channels;
        for (int i = 0; i < frame.columns * channels; i += 16) {
            prefetch(pass.color + first + i);
            prefetch(pass.grad_color + first + i);
        }
    }
}

// Sum over the tile's pixels of T_N g, in a fixed order.
ETSPLAT_FN void background_gradient(const RasterPass& pass, const BackwardTile& tile, const TileFrame& frame, float* out) {
    const int channels = pass.channels();
    for (int c = 0; c < channels; ++c) out[c] = 0.0f;
    for (int block = 0; block < kBlocks; ++block)
        for (int row = 0; row < frame.row_count(block); ++row) {
            const int64_t pixel = frame.pixel(block, row, pass.width);
            for (int i = 0; i < frame.column_count(block); ++i)
                for (int c = 0; c < channels; ++c)
                    out[c] += (1.0f - pass.alpha[pixel + i]) * tile.channel(c, block)[4 * row + i];
        }
}

template <Shape kShape>
ETSPLAT_FN SlotLayout layout_of(const RasterPass& pass) {
    if constexpr (kShape == Shape::kFlat) return {kFastChannels, 0, DistortionDepth::kNone};
    if constexpr (kShape == Shape::kCorner) return {0, kFastChannels, DistortionDepth::kNone};
    return pass.slot_layout;
}

// What a slot will keep, lane by lane: in variables where the number is known, which may be registers, else the first of
// them in variables and the others in memory.
template <Shape kShape>
struct SlotSums {
    static constexpr bool kGeneral = kShape == Shape::kGeneral;
    static constexpr int kVectors = kGeneral ? SlotLayout::kFlat : kShape == Shape::kFlat ? 16 : 32;
    Vec v[kVectors];
    float* lanes;

    ETSPLAT_FN explicit SlotSums(const RasterPass& pass, float* memory) : lanes(memory) {
        for (int i = 0; i < kVectors; ++i) v[i] = Vec(0.0f);
        if constexpr (kGeneral)
            for (int i = kVectors; i < pass.slot_layout.size(); ++i) Vec(0.0f).store(lanes + 16 * i);
    }
    // Adds a b to sum i, which is none of the first kFlat.
    ETSPLAT_FN void add(int i, Vec a, Vec b) {
        if constexpr (kGeneral)
            vfma(a, b, Vec::load(lanes + 16 * i)).store(lanes + 16 * i);
        else
            v[i] = vfma(a, b, v[i]);
    }
    ETSPLAT_FN void add(int i, Vec a) {
        if constexpr (kGeneral)
            (Vec::load(lanes + 16 * i) + a).store(lanes + 16 * i);
        else
            v[i] = v[i] + a;
    }

    ETSPLAT_FN void write(const RasterPass& pass, float* slot) const {
        if constexpr (kGeneral) {
            for (int i = 0; i < kVectors; ++i) slot[i] = lane_sum(v[i]);
            for (int i = kVectors; i < pass.slot_layout.size(); ++i) slot[i] = lane_sum(Vec::load(lanes + 16 * i));
        } else {
            for (int i = 0; i < kVectors; i += 16) column_sums(v + i, slot + i);
        }
    }
};

// Interpolated channels and distortion of one block: their part of the cotangent of the blend weight, and the gradients of
// what they were computed from.
template <Shape kShape>
struct ExtraGradients {
    static constexpr bool kGeneral = kShape == Shape::kGeneral;
    const RasterPass& pass;
    const AttributeRecord& record;
    const float* corners;
    Interpolation<Vec> at;
    Vec inverse_z;
    Vec grad_value[3], mean;  // sum over channels of g_c (colour of corner k), and its mean over the corners

    ETSPLAT_FN ExtraGradients(const RasterPass& p, int32_t triangle)
        : pass(p), record(p.attribute_records[triangle]),
          corners(p.corner_colors + int64_t{3} * triangle * p.corner_channels), inverse_z(1.0f / record.centroid_z) {
        for (int k = 0; k < 3; ++k) grad_value[k] = Vec(0.0f);
    }
    ETSPLAT_FN bool interpolates() const { return !kGeneral || pass.attributes; }
    ETSPLAT_FN bool distorts() const { return kGeneral && pass.grad_distortion; }
    ETSPLAT_FN int channels() const { return kGeneral ? pass.corner_channels : kFastChannels; }

    ETSPLAT_FN Vec cotangent(const BackwardTile& tile, const Vec form[3], int block) {
        Vec result(0.0f);
        if (interpolates()) {
            at.evaluate(record, form);
            if (kGeneral && pass.distortion_depth == DistortionDepth::kPlane) inverse_z = at.inverse_z_sum / at.sum;
            for (int c = 0; c < channels(); ++c) {
                const Vec g = Vec::load(tile.channel(flat_channels<kShape>(pass) + c, block));
                for (int k = 0; k < 3; ++k) grad_value[k] = vfma(g, Vec(corners[k * channels() + c]), grad_value[k]);
            }
            mean = at.mean(grad_value[0], grad_value[1], grad_value[2]);
            result = mean;
        }
        if (distorts()) {
            const Vec spread = distortion_spread(coordinate(tile), Vec::load(tile.total_weight[block]),
                                                 Vec::load(tile.total_first[block]), Vec::load(tile.total_second[block]));
            result = vfma(Vec::load(tile.grad_distortion[block]), spread, result);
        }
        return result;
    }

    ETSPLAT_FN Vec coordinate(const BackwardTile& tile) const {
        return distortion_coordinate(pass.distortion_near, pass.distortion_far, tile.first_inverse_z, inverse_z);
    }

    // Gradients by the forms go to grad_form, the others to the slot. Nothing to mask: w is 0 where nothing is drawn.
    ETSPLAT_FN void accumulate(const BackwardTile& tile, int block, VecMask drawn, Vec w, SlotSums<kShape>& sums,
                               Vec grad_form[3]) {
        const SlotLayout layout = layout_of<kShape>(pass);
        Vec grad_inverse_z(0.0f);
        if (distorts()) {
            const Vec slope = distortion_slope(pass.distortion_near, pass.distortion_far, coordinate(tile), w,
                                               Vec::load(tile.total_weight[block]), Vec::load(tile.total_first[block]));
            grad_inverse_z = keep(drawn, Vec::load(tile.grad_distortion[block]) * slope);
            if (pass.distortion_depth == DistortionDepth::kCentroid)
                sums.add(layout.centroid(), Vec(0.0f) - grad_inverse_z * inverse_z * inverse_z);
        }
        if (!interpolates()) return;
        InterpolationGradient<Vec> gradient;
        const bool plane = distorts() && pass.distortion_depth == DistortionDepth::kPlane;
        gradient.evaluate(record, at, w, grad_value, mean, plane, grad_inverse_z, inverse_z);
        const Vec share = w * at.inverse;
        for (int k = 0; k < 3; ++k) {
            for (int c = 0; c < channels(); ++c)
                sums.add(layout.corner() + k * channels() + c, share * at.product[k],
                         Vec::load(tile.channel(flat_channels<kShape>(pass) + c, block)));
            sums.add(layout.product() + k, gradient.log_product[k]);
            if (plane) sums.add(layout.plane() + k, gradient.log_weight[k]);
            grad_form[k] = gradient.form[k];
        }
    }
};

// Gradients of one triangle of the batch, over the blocks in which it was drawn.
template <Shape kShape>
ETSPLAT_FN void differentiate(const RasterPass& pass, BackwardTile& tile, const BackwardBatch& batch, int triangle) {
    const TileEntry& entry = batch.entries[triangle];
    const TriangleForms& forms = batch.forms[triangle];
    const int flat = flat_channels<kShape>(pass);
    const float* color = pass.flat_colors + int64_t{entry.triangle} * flat;
    const Vec opacity(pass.records[entry.triangle].opacity);
    const Vec alpha_max(pass.alpha_max), transmittance_min(pass.transmittance_min);
    SlotSums<kShape> sums(pass, tile.sums);

    for (int pair = batch.begin[triangle]; pair < batch.begin[triangle + 1]; ++pair) {
        const int block = batch.pairs.block[pair];
        const PairGradient& gain = batch.gradients[pair];
        const Vec value = Vec::load(gain.value), raw_alpha = opacity * value;
        const Vec alpha = vmin(raw_alpha, alpha_max);
        const Vec transmittance = Vec::load(tile.transmittance[block]);
        const unsigned alive = tile.alive[block];
        const VecMask mask = VecMask::from_bits(alive & batch.visible[pair]);
        const Vec all = alpha * transmittance, rest = transmittance - all;
        const VecMask stop = mask & (rest < transmittance_min), drawn = mask & (rest >= transmittance_min);
        tile.alive[block] = static_cast<uint16_t>(alive & ~stop.bits());
        const Vec w = keep(drawn, all);
        vselect(drawn, rest, transmittance).store(tile.transmittance[block]);

        // cotangent of the blend weight, and what else comes of colours
        Vec cotangent(0.0f), grad_form[3] = {cotangent, cotangent, cotangent};
        for (int c = 0; c < flat; ++c) {
            const Vec g = Vec::load(tile.channel(c, block));
            cotangent = vfma(g, Vec(color[c]), cotangent);
            sums.add(SlotLayout::kFlat + c, w, g);
        }
        if constexpr (kShape != Shape::kFlat)
            if (kShape == Shape::kCorner || pass.attributes || pass.grad_distortion) {
                const Vec form[3] = {forms.value(0, block), forms.value(1, block), forms.value(2, block)};
                ExtraGradients<kShape> extra(pass, entry.triangle);
                cotangent = cotangent + extra.cotangent(tile, form, block);
                extra.accumulate(tile, block, drawn, w, sums, grad_form);
            }
        const Vec remaining = Vec::load(tile.remaining[block]) - w * cotangent;
        remaining.store(tile.remaining[block]);
        Vec grad_alpha = transmittance * cotangent - remaining * vreciprocal(Vec(1.0f) - alpha);
        grad_alpha = keep(drawn & (raw_alpha < alpha_max), grad_alpha);

        sums.v[SlotLayout::kOpacity] = vfma(grad_alpha, value, sums.v[SlotLayout::kOpacity]);
        const Vec grad_kernel = grad_alpha * opacity;
        sums.v[SlotLayout::kSigma] = vfma(grad_kernel, Vec::load(gain.dsigma), sums.v[SlotLayout::kSigma]);

        const Vec dx = forms.dx(block), dy = forms.dy(block);
        for (int k = 0; k < 3; ++k) {
            const Vec part = grad_kernel * Vec::load(gain.slope[k]);
            grad_form[k] = kShape == Shape::kFlat ? part : grad_form[k] + part;
            sums.v[SlotLayout::kMoment + k] = sums.v[SlotLayout::kMoment + k] + grad_form[k];
            sums.v[SlotLayout::kMomentX + k] = vfma(grad_form[k], dx, sums.v[SlotLayout::kMomentX + k]);
            sums.v[SlotLayout::kMomentY + k] = vfma(grad_form[k], dy, sums.v[SlotLayout::kMomentY + k]);
        }
    }

    sums.write(pass, pass.slots + int64_t{entry.slot} * pass.slot_layout.stride());
    pass.touched[entry.slot] = 1;
}

template <class Kernel, Shape kShape>
void backward_tile(const RasterPass& pass, int index, float* scratch) {
    if (pass.tile_begin[index] == pass.tile_done[index] && !pass.tile_background) return;
    const TileFrame frame(pass, index);
    BackwardTile tile;
    tile.grad_color = scratch;
    constexpr bool kGeneral = kShape == Shape::kGeneral;
    if constexpr (kGeneral) tile.first_inverse_z = first_inverse_depth(pass, index);
    tile.sums = scratch + 256 * pass.channels();
    begin(pass, tile, frame, kGeneral);
    if (pass.tile_background) background_gradient(pass, tile, frame, pass.tile_background + int64_t{index} * pass.channels());
    prefetch_images(pass, index + 1);
    BackwardBatch batch;
    const int end = pass.tile_done[index];
    for (int next = pass.tile_begin[index]; next < end;) {
        next = collect(pass, frame, next, end, pass.tile_begin[index + 1], batch);
        evaluate<Kernel>(pass, batch);
        for (int i = 0; i < batch.count; ++i) differentiate<kShape>(pass, tile, batch, i);
    }
}

}  // namespace etsplat::ETSPLAT_SIMD
