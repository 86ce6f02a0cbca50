// Gradients of one tile, front to back with one running scalar per pixel.
//
// S starts as everything the pixel's cotangents see behind the first triangle, <g, C with background> - g_A T_N
// (+ 2 g_D D), and loses each triangle's share as it passes:  dL/dalpha_k = T_k (cotangent of k) - S_k / (1 - alpha_k).
// Blocks are the ones the forward pass recorded. Sums over pixels are kept per (triangle, tile) in a slot of their own,
// one or more whole cache lines, and added up per triangle afterwards in a fixed order: no atomics, and the same bits
// for any number of threads.
#pragma once

#include "tile.h"

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
        const long pixel = frame.pixel(block, row, pass.width);
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
        const long pixel = static_cast<long>(frame.y0 + row) * pass.width + frame.x0;
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
        const long pixel = frame.pixel(block, row, pass.width);
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

// Sum over the tile's pixels of T_N g, in a fixed order.
ETSPLAT_FN void background_gradient(const RasterPass& pass, const BackwardTile& tile, const TileFrame& frame, float* out) {
    const int channels = pass.channels();
    for (int c = 0; c < channels; ++c) out[c] = 0.0f;
    for (int block = 0; block < kBlocks; ++block)
        for (int row = 0; row < frame.row_count(block); ++row) {
            const long pixel = frame.pixel(block, row, pass.width);
            for (int i = 0; i < frame.column_count(block); ++i)
                for (int c = 0; c < channels; ++c)
                    out[c] += (1.0f - pass.alpha[pixel + i]) * tile.channel(c, block)[4 * row + i];
        }
}

ETSPLAT_FN void add_lanes(float* sums, int index, Vec value) {
    float* out = sums + 16 * index;
    (Vec::load(out) + value).store(out);
}

// Interpolated channels and distortion of one block: adds their part to the cotangent of the blend weight, and sums the
// gradients of what they were computed from.
struct ExtraGradients {
    const RasterPass& pass;
    const AttributeRecord& record;
    const float* corners;
    Interpolation<Vec> at;
    Vec inverse_z;
    Vec grad_value[3];  // sum over channels of g_c (colour of corner k)

    ETSPLAT_FN Vec cotangent(const BackwardTile& tile, const TriangleForms& forms, int block) {
        Vec result(0.0f);
        inverse_z = Vec(1.0f / record.centroid_z);
        for (int k = 0; k < 3; ++k) grad_value[k] = Vec(0.0f);
        if (pass.attributes) {
            at.evaluate(record, forms.dx(block), forms.dy(block));
            if (pass.distortion_depth == DistortionDepth::kPlane) inverse_z = at.inverse_z_sum / at.sum;
            for (int c = 0; c < pass.corner_channels; ++c) {
                const Vec g = Vec::load(tile.channel(pass.flat_channels + c, block));
                for (int k = 0; k < 3; ++k)
                    grad_value[k] = vfma(g, Vec(corners[k * pass.corner_channels + c]), grad_value[k]);
            }
            for (int k = 0; k < 3; ++k) result = vfma(at.weight[k], grad_value[k], result);
        }
        if (pass.grad_distortion) {
            const Vec spread = distortion_spread(coordinate(tile), Vec::load(tile.total_weight[block]),
                                                 Vec::load(tile.total_first[block]), Vec::load(tile.total_second[block]));
            result = vfma(Vec::load(tile.grad_distortion[block]), spread, result);
        }
        return result;
    }

    ETSPLAT_FN Vec coordinate(const BackwardTile& tile) const {
        return distortion_coordinate(pass.distortion_near, pass.distortion_far, tile.first_inverse_z, inverse_z);
    }

    ETSPLAT_FN void accumulate(BackwardTile& tile, const TriangleForms& forms, int block, VecMask drawn, Vec w) {
        const SlotLayout& layout = pass.slot_layout;
        Vec grad_inverse_z(0.0f);
        if (pass.grad_distortion) {
            const Vec slope = distortion_slope(pass.distortion_near, pass.distortion_far, coordinate(tile), w,
                                               Vec::load(tile.total_weight[block]), Vec::load(tile.total_first[block]));
            grad_inverse_z = keep(drawn, Vec::load(tile.grad_distortion[block]) * slope);
            if (pass.distortion_depth == DistortionDepth::kCentroid)
                add_lanes(tile.sums, layout.depth(), Vec(0.0f) - grad_inverse_z * inverse_z * inverse_z);
        }
        if (!pass.attributes) return;
        InterpolationGradient<Vec> gradient;
        const bool plane = pass.grad_distortion && pass.distortion_depth == DistortionDepth::kPlane;
        gradient.evaluate(record, at, w, grad_value, plane, grad_inverse_z, inverse_z);
        const Vec dx = forms.dx(block), dy = forms.dy(block);
        for (int k = 0; k < 3; ++k) {
            for (int c = 0; c < pass.corner_channels; ++c) {
                const Vec g = Vec::load(tile.channel(pass.flat_channels + c, block));
                add_lanes(tile.sums, layout.corner() + k * pass.corner_channels + c, keep(drawn, w * at.weight[k] * g));
            }
            const Vec grad_a = keep(drawn, gradient.barycentric[k]);
            add_lanes(tile.sums, layout.inverse_z() + k, keep(drawn, gradient.inverse_z[k]));
            add_lanes(tile.sums, layout.barycentric() + k, grad_a);
            add_lanes(tile.sums, layout.barycentric() + 3 + k, grad_a * dx);
            add_lanes(tile.sums, layout.barycentric() + 6 + k, grad_a * dy);
        }
    }
};

template <class Kernel, bool General>
ETSPLAT_FN void differentiate(const RasterPass& pass, BackwardTile& tile, const TileFrame& frame, const TileEntry& entry) {
    const unsigned blocks = pass.hits[entry.slot];
    if (blocks == 0) return;
    const TriangleRecord& record = pass.records[entry.triangle];
    TriangleForms forms;
    forms.prepare(record, frame);

    const int flat = General ? pass.flat_channels : kMaxFastChannels;
    const float* color = pass.flat_colors + int64_t{entry.triangle} * flat;
    const Vec exponent(record.exponent), scale(record.scale), opacity(record.opacity), extent(record.extent);
    const Vec alpha_min(pass.alpha_min), alpha_max(pass.alpha_max), transmittance_min(pass.transmittance_min);
    Vec sums[16];
    for (int i = 0; i < 16; ++i) sums[i] = Vec(0.0f);
    if constexpr (General)
        for (int i = 0; i < pass.slot_layout.stride(); ++i) Vec(0.0f).store(tile.sums + 16 * i);

    for_each_bit(blocks, [&](int block) {
        const Vec form0 = forms.value(0, block), form1 = forms.value(1, block), form2 = forms.value(2, block);
        const Vec x = vmax(form0, vmax(form1, form2));
        const KernelValue<Vec> kernel = Kernel::gradient(x, exponent, scale);
        const Vec raw_alpha = opacity * kernel.value;
        const Vec alpha = vmin(raw_alpha, alpha_max);
        const Vec transmittance = Vec::load(tile.transmittance[block]);
        const unsigned alive = tile.alive[block];
        const VecMask mask = (x <= extent) & (alpha >= alpha_min) & VecMask::from_bits(alive);
        Vec w = alpha * transmittance;
        const VecMask stop = mask & (transmittance - w < transmittance_min);
        tile.alive[block] = static_cast<uint16_t>(alive & ~stop.bits());
        const VecMask drawn = and_not(mask, stop);
        w = keep(drawn, w);
        (transmittance - w).store(tile.transmittance[block]);

        // cotangent of the blend weight
        Vec cotangent(0.0f);
        for (int c = 0; c < flat; ++c) {
            const Vec g = Vec::load(tile.channel(c, block));
            cotangent = vfma(g, Vec(color[c]), cotangent);
            if constexpr (General)
                add_lanes(tile.sums, SlotLayout::kFlat + c, w * g);
            else
                sums[SlotLayout::kFlat + c] = vfma(w, g, sums[SlotLayout::kFlat + c]);
        }
        if constexpr (General) {
            if (pass.attributes || pass.grad_distortion) {
                ExtraGradients extra{pass, pass.attribute_records[entry.triangle],
                                     pass.corner_colors + int64_t{3} * entry.triangle * pass.corner_channels, {}, {}, {}};
                cotangent = cotangent + extra.cotangent(tile, forms, block);
                extra.accumulate(tile, forms, block, drawn, w);
            }
        }
        const Vec remaining = Vec::load(tile.remaining[block]) - w * cotangent;
        remaining.store(tile.remaining[block]);
        Vec grad_alpha = transmittance * cotangent - remaining * vreciprocal(Vec(1.0f) - alpha);
        grad_alpha = keep(drawn & (raw_alpha < alpha_max), grad_alpha);

        sums[SlotLayout::kOpacity] = vfma(grad_alpha, kernel.value, sums[SlotLayout::kOpacity]);
        const Vec grad_kernel = grad_alpha * opacity;
        sums[SlotLayout::kSigma] = vfma(grad_kernel, kernel.dsigma, sums[SlotLayout::kSigma]);
        const Vec grad_x = grad_kernel * kernel.dx;

        const Vec dx = forms.dx(block), dy = forms.dy(block);
        const VecMask first = form0 >= x, second = and_not(form1 >= x, first);
        const Vec part[3] = {keep(first, grad_x), keep(second, grad_x), keep(and_not(and_not(drawn, first), second), grad_x)};
        for (int k = 0; k < 3; ++k) {
            sums[SlotLayout::kMoment + k] = sums[SlotLayout::kMoment + k] + part[k];
            sums[SlotLayout::kMomentX + k] = vfma(part[k], dx, sums[SlotLayout::kMomentX + k]);
            sums[SlotLayout::kMomentY + k] = vfma(part[k], dy, sums[SlotLayout::kMomentY + k]);
        }
    });

    float* slot = pass.slots + int64_t{entry.slot} * pass.slot_layout.stride();
    if constexpr (General) {
        for (int i = 0; i < SlotLayout::kFlat; ++i) sums[i].store(tile.sums + 16 * i);
        for (int i = 0; i < pass.slot_layout.size(); ++i) slot[i] = lane_sum(Vec::load(tile.sums + 16 * i));
    } else {
        column_sums(sums, slot);
    }
    pass.touched[entry.slot] = 1;
}

template <class Kernel, bool General>
void backward_tile(const RasterPass& pass, int index, float* scratch) {
    const TileFrame frame(pass, index);
    BackwardTile tile;
    tile.grad_color = scratch;
    if constexpr (General) tile.first_inverse_z = first_inverse_depth(pass, index);
    tile.sums = scratch + 256 * pass.channels();
    begin(pass, tile, frame, General);
    if (pass.tile_background) background_gradient(pass, tile, frame, pass.tile_background + int64_t{index} * pass.channels());
    constexpr int kAhead = 8;
    const int end = pass.tile_done[index];
    for (int i = pass.tile_begin[index]; i < end; ++i) {
        const TileEntry& coming = pass.entries[i + kAhead < end ? i + kAhead : end - 1];
        prefetch(pass.records + coming.triangle);
        prefetch(pass.hits + coming.slot);
        prefetch(pass.flat_colors + int64_t{coming.triangle} * pass.flat_channels);
        differentiate<Kernel, General>(pass, tile, frame, pass.entries[i]);
    }
}

}  // namespace etsplat::ETSPLAT_SIMD
