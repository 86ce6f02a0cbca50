// Front-to-back compositing (paper, equation 1): a block per tile, a thread per pixel.
//
// Triangles come in batches, staged in shared memory by the threads side by side, each with the sub-tiles it can touch. A
// warp goes through those of its own sub-tile only, in order, with everything about a pixel in registers; it is idle when all
// of its pixels have stopped, and the block ends when all warps are. For the backward pass each slot gets a bit per sub-tile
// in which the triangle was drawn or stopped a pixel.
#include "cuda/raster_tile.h"

namespace etsplat {

constexpr int kForwardBatch = sizeof(Staged) <= 112 ? 256 : sizeof(Staged) <= 224 ? 128 : 64;
constexpr int kChunks = kForwardBatch / kWarp;

struct ForwardPixel {
    float transmittance = 1.0f, color[kChannels] = {};
    float first = 0.0f, second = 0.0f, distortion = 0.0f;  // sum w m, sum w m^2
    int median = 0;
    bool alive = false;
};

__device__ __forceinline__ void draw_extras(const RasterPass& pass, const Staged& s, const Forms& f, float first_inverse_z,
                                            float w, float rest, ForwardPixel& p) {
    if (MEDIAN && p.transmittance > 0.5f && rest <= 0.5f) p.median = s.triangle + 1;
    if (!kAttributes && DISTORTION == 0) return;
    Interpolation<float> at;
    float inverse_z = 0.0f;
    if (kAttributes) {
        at.evaluate(s.attributes.get(), f.form);
        for (int c = 0; c < CORNER; ++c) {
            const float value = at.mean(s.corner[c], s.corner[CORNER + c], s.corner[2 * CORNER + c]);
            p.color[FLAT + c] = vfma(w, value, p.color[FLAT + c]);
        }
        inverse_z = 1.0f / at.depth();
    }
    if (DISTORTION == 0) return;
    if (DISTORTION == 2) inverse_z = 1.0f / s.centroid_z;
    const float m = distortion_coordinate(pass.distortion_near, pass.distortion_far, first_inverse_z, inverse_z);
    p.distortion += w * distortion_spread(m, 1.0f - p.transmittance, p.first, p.second);
    p.first += w * m;
    p.second += w * m * m;
}

// Whether the triangle counts in this pixel: it is drawn, or stops it.
__device__ __forceinline__ bool draw(const RasterPass& pass, const Staged& s, const Pixel& pixel, float first_inverse_z,
                                     ForwardPixel& p, float& w) {
    w = 0.0f;
    const Forms f(s, pixel);
    if (!(p.alive && f.x <= s.extent)) return false;
    const KERNEL kernel = kernel_with<KERNEL>(pass.kernel_table);
    const float alpha = vmin(s.opacity * kernel.value(f.x, s.exponent, s.scale), pass.alpha_max);
    if (!(alpha >= pass.alpha_min)) return false;
    const float rest = vfma(-alpha, p.transmittance, p.transmittance);
    if (rest < pass.transmittance_min) {
        p.alive = false;
        return true;
    }
    w = alpha * p.transmittance;
    for (int c = 0; c < FLAT; ++c) p.color[c] = vfma(w, s.color[c], p.color[c]);
    draw_extras(pass, s, f, first_inverse_z, w, rest, p);
    p.transmittance = rest;
    return true;
}

__device__ __forceinline__ void write_pixel(const RasterPass& pass, const Pixel& pixel, const ForwardPixel& p) {
    if (!pixel.inside) return;
    for (int c = 0; c < kChannels; ++c) {
        const float background = pass.backgrounds ? pass.backgrounds[pixel.view * kChannels + c] : 0.0f;
        pass.color[pixel.index * kChannels + c] = vfma(p.transmittance, background, p.color[c]);
    }
    pass.alpha[pixel.index] = 1.0f - p.transmittance;
    if (MEDIAN) pass.median_triangle[pixel.index] = p.median;
    if (DISTORTION != 0) {
        pass.distortion[pixel.index] = p.distortion;
        pass.distortion_totals[2 * pixel.index] = p.first;
        pass.distortion_totals[2 * pixel.index + 1] = p.second;
    }
}

}  // namespace etsplat

using namespace etsplat;

extern "C" __global__ void __launch_bounds__(256) raster_forward(const __grid_constant__ RasterPass pass) {
    __shared__ Staged staged[kForwardBatch];
    __shared__ unsigned char touched[kForwardBatch];
    __shared__ unsigned hit_words[kWarps][kChunks];
    const int t = threadIdx.x, warp = warp_index(), lane = lane_index(), tile = tile_of_block(pass);
    const Pixel pixel(pass, tile);
    const int begin = pass.tile_ranges[2 * tile], end = pass.tile_ranges[2 * tile + 1];
    const float first_inverse_z = first_inverse_depth(pass, begin, end);
    ForwardPixel p;
    p.alive = pixel.inside;
    int next = begin;
    while (next < end && __syncthreads_or(p.alive)) {
        const int count = end - next < kForwardBatch ? end - next : kForwardBatch;
        if (t < kForwardBatch) {
            touched[t] = 0;
            if (t < count) {
                const int m = static_cast<int>(pass.slot_triangle[pass.sorted_slots[next + t]]);
                const TriangleRecord record = load_record(pass, m);
                stage(pass, staged[t], record, m);
                touched[t] = static_cast<unsigned char>(sub_tiles(record, pixel.x0, pixel.y0));
            }
        }
        if (t < kWarps * kChunks) hit_words[t / kChunks][t % kChunks] = 0;
        __syncthreads();
        for (int chunk = 0; chunk * kWarp < count && __any_sync(kAllLanes, p.alive); ++chunk) {
            unsigned todo = __ballot_sync(kAllLanes, touched[chunk * kWarp + lane] >> warp & 1), hits = 0;
            for (; todo != 0; todo &= todo - 1) {
                const int k = __ffs(static_cast<int>(todo)) - 1;
                const Staged& s = staged[chunk * kWarp + k];
                float w;
                const bool counts = draw(pass, s, pixel, first_inverse_z, p, w);
                if (!__any_sync(kAllLanes, counts)) continue;
                hits |= 1u << k;
                if (WEIGHTS) {
                    for (int d = kWarp / 2; d > 0; d /= 2) w = vmax(w, __shfl_xor_sync(kAllLanes, w, d));
                    const long long m = static_cast<long long>(pixel.view) * pass.triangles + s.triangle;
                    // weights are not negative: their bits are ordered as they are
                    if (lane == 0 && w > 0.0f) atomicMax(reinterpret_cast<int*>(pass.max_weight) + m, __float_as_int(w));
                }
            }
            if (lane == 0) hit_words[warp][chunk] = hits;
        }
        __syncthreads();
        if (t < count && pass.hits) {
            unsigned bits = 0;
            for (int w = 0; w < kWarps; ++w) bits |= (hit_words[w][t / kWarp] >> t % kWarp & 1) << w;
            pass.hits[pass.sorted_slots[next + t]] = static_cast<unsigned char>(bits);
        }
        next += count;
    }
    if (t == 0) pass.tile_done[tile] = next;
    write_pixel(pass, pixel, p);
}
