// Gradients of the tile loop: a block per tile, front to back with one running scalar per pixel.
//
// S starts as everything the pixel's cotangents see behind the first triangle, <g, C with background> - g_A T_N + 2 g_D D, and
// loses each triangle's share as it passes:  dL/dalpha_k = T_k (cotangent of k) - S_k / (1 - alpha_k).
//
// Only slots with hits are looked at. A warp sums over its pixels by an exchange that halves the number of values at each of
// five steps: 16 shuffles for 16 values, where a sum each would take 80. The warps' sums meet in shared memory and are added
// in order into the slot, which no other block writes: no atomics, and the same bits every time. raster_reduce adds up the
// slots of each triangle.
#include "cuda/raster_tile.h"

namespace etsplat {

constexpr int kSumsRoom = 24576;  // bytes of shared memory for the warps' sums
constexpr int kFit = kSumsRoom / (kWarps * kStride * 4);
constexpr int kSub = kFit < kWarp ? kFit : kWarp;  // triangles at a time
static_assert(kSub >= 1);

struct BackwardPixel {
    float transmittance = 1.0f, remaining = 0.0f, grad[kChannels] = {};
    float grad_distortion = 0.0f, total_weight = 0.0f, total_first = 0.0f, total_second = 0.0f;
    bool alive = false;
};

__device__ __forceinline__ BackwardPixel load_pixel(const RasterPass& pass, const Pixel& pixel) {
    BackwardPixel p;
    p.alive = pixel.inside;
    if (!pixel.inside) return p;
    for (int c = 0; c < kChannels; ++c) {
        p.grad[c] = pass.grad_color ? pass.grad_color[pixel.index * kChannels + c] : 0.0f;
        p.remaining = vfma(p.grad[c], pass.color[pixel.index * kChannels + c], p.remaining);
    }
    p.total_weight = pass.alpha[pixel.index];
    if (pass.grad_alpha) p.remaining -= pass.grad_alpha[pixel.index] * (1.0f - p.total_weight);
    if (DISTORTION != 0) {
        p.grad_distortion = pass.grad_distortion[pixel.index];
        p.total_first = pass.distortion_totals[2 * pixel.index];
        p.total_second = pass.distortion_totals[2 * pixel.index + 1];
        p.remaining += 2.0f * p.grad_distortion * pass.distortion[pixel.index];
    }
    return p;
}

__device__ __forceinline__ void add_moments(const Forms& f, int k, float grad_form, float (&sums)[kStride]) {
    sums[SlotLayout::kMoment + k] += grad_form;
    sums[SlotLayout::kMomentX + k] += grad_form * f.dx;
    sums[SlotLayout::kMomentY + k] += grad_form * f.dy;
}

// The interpolated channels and the distortion at one pixel.
struct Extras {
    Interpolation<float> at;
    float inverse_z = 0.0f, coordinate = 0.0f, grad_value[3] = {}, mean = 0.0f;

    // Their part of the cotangent of the blend weight.
    __device__ __forceinline__ float cotangent(const RasterPass& pass, const Staged& s, const Forms& f,
                                               float first_inverse_z, const BackwardPixel& p) {
        float result = 0.0f;
        if (kAttributes) {
            at.evaluate(s.attributes.get(), f.form);
            inverse_z = at.inverse_z_sum / at.sum;
            for (int c = 0; c < CORNER; ++c)
                for (int k = 0; k < 3; ++k) grad_value[k] = vfma(p.grad[FLAT + c], s.corner[k * CORNER + c], grad_value[k]);
            result = mean = at.mean(grad_value[0], grad_value[1], grad_value[2]);
        }
        if (DISTORTION != 0) {
            if (DISTORTION == 2) inverse_z = 1.0f / s.centroid_z;
            coordinate = distortion_coordinate(pass.distortion_near, pass.distortion_far, first_inverse_z, inverse_z);
            const float spread = distortion_spread(coordinate, p.total_weight, p.total_first, p.total_second);
            result = vfma(p.grad_distortion, spread, result);
        }
        return result;
    }

    __device__ __forceinline__ void add(const RasterPass& pass, const Staged& s, const Forms& f, const BackwardPixel& p,
                                        float w, float (&sums)[kStride]) const {
        float grad_inverse_z = 0.0f;
        if (DISTORTION != 0) {
            grad_inverse_z = p.grad_distortion * distortion_slope(pass.distortion_near, pass.distortion_far, coordinate, w,
                                                                  p.total_weight, p.total_first);
            if (DISTORTION == 2) sums[kLayout.centroid()] = -grad_inverse_z * inverse_z * inverse_z;
        }
        if (!kAttributes) return;
        InterpolationGradient<float> gradient;
        gradient.evaluate(s.attributes.get(), at, w, grad_value, mean, DISTORTION == 1, grad_inverse_z, inverse_z);
        const float share = w * at.inverse;
        for (int k = 0; k < 3; ++k) {
            for (int c = 0; c < CORNER; ++c)
                sums[kLayout.corner() + k * CORNER + c] = share * at.product[k] * p.grad[FLAT + c];
            sums[kLayout.product() + k] = gradient.log_product[k];
            if (DISTORTION == 1) sums[kLayout.plane() + k] = gradient.log_weight[k];
            add_moments(f, k, gradient.form[k], sums);
        }
    }
};

// One triangle at one pixel: its terms of the slot's sums, and the pixel's state behind it.
__device__ __forceinline__ void differentiate(const RasterPass& pass, const Staged& s, const Pixel& pixel,
                                              float first_inverse_z, BackwardPixel& p, float (&sums)[kStride]) {
    const Forms f(s, pixel);
    if (!(p.alive && f.x <= s.extent)) return;
    const KernelValue<float> gain = kernel_with<KERNEL>(pass.kernel_table).gradient(f.x, s.exponent, s.scale);
    const float raw_alpha = s.opacity * gain.value, alpha = vmin(raw_alpha, pass.alpha_max);
    if (!(alpha >= pass.alpha_min)) return;
    const float rest = vfma(-alpha, p.transmittance, p.transmittance);
    if (rest < pass.transmittance_min) {
        p.alive = false;
        return;
    }
    const float w = alpha * p.transmittance;
    float cotangent = 0.0f;
    for (int c = 0; c < FLAT; ++c) {
        cotangent = vfma(p.grad[c], s.color[c], cotangent);
        sums[SlotLayout::kFlat + c] = w * p.grad[c];
    }
    if (kAttributes || DISTORTION != 0) {
        Extras extras;
        cotangent += extras.cotangent(pass, s, f, first_inverse_z, p);
        extras.add(pass, s, f, p, w, sums);
    }
    p.remaining -= w * cotangent;
    const float grad_alpha = p.transmittance * cotangent - p.remaining * vreciprocal(1.0f - alpha);
    p.transmittance = rest;
    if (!(raw_alpha < pass.alpha_max)) return;
    const float grad_kernel = grad_alpha * s.opacity, grad_x = grad_kernel * gain.dx;
    sums[SlotLayout::kOpacity] = grad_alpha * gain.value;
    sums[SlotLayout::kSigma] = grad_kernel * gain.dsigma;
    const int largest = f.form[0] >= f.x ? 0 : f.form[1] >= f.x ? 1 : 2;
    for (int k = 0; k < 3; ++k) add_moments(f, k, k == largest ? grad_x : 0.0f, sums);
}

// A step of the exchange: each lane gives the values of one half and keeps the sums of the other. Templates, as a loop over
// the half is not unrolled: its values would be indexed, in local memory.
template <int Half>
__device__ __forceinline__ void exchange_halves(float (&v)[16]) {
    const bool upper = (lane_index() & 2 * Half) != 0;
#pragma unroll
    for (int j = 0; j < Half; ++j) {
        const float low = v[j], high = v[Half + j];
        v[j] = (upper ? high : low) + __shfl_xor_sync(kAllLanes, upper ? low : high, 2 * Half);
    }
    if constexpr (Half > 1) exchange_halves<Half / 2>(v);
}

// Sums over the warp of 16 values; lane 2 j gets that of values[j].
__device__ __forceinline__ float sum_sixteen(const float* values) {
    float v[16];
#pragma unroll
    for (int j = 0; j < 16; ++j) v[j] = values[j];
    exchange_halves<8>(v);
    return v[0] + __shfl_xor_sync(kAllLanes, v[0], 1);
}

// Sum over the tile's pixels of T_N g.
__device__ __forceinline__ void background_gradient(const RasterPass& pass, int tile, const BackwardPixel& p, bool inside,
                                                    float (*part)[kChannels]) {
    const float rest = inside ? 1.0f - p.total_weight : 0.0f;
    for (int c = 0; c < kChannels; ++c) {
        const float sum = warp_sum(rest * p.grad[c]);
        if (lane_index() == 0) part[warp_index()][c] = sum;
    }
    __syncthreads();
    if (threadIdx.x < kChannels) {
        float sum = 0.0f;
        for (int w = 0; w < kWarps; ++w) sum += part[w][threadIdx.x];
        pass.tile_background[static_cast<long long>(tile) * kChannels + threadIdx.x] = sum;
    }
}

}  // namespace etsplat

using namespace etsplat;

extern "C" __global__ void __launch_bounds__(256) raster_backward(const __grid_constant__ RasterPass pass) {
    __shared__ Staged staged[kSub];
    __shared__ float warp_sums[kWarps][kSub][kStride];
    __shared__ float background_part[kWarps][kChannels];
    __shared__ unsigned listed_slot[kTileThreads], listed_hits[kTileThreads], counts[kWarps];
    const int t = threadIdx.x, warp = warp_index(), lane = lane_index(), tile = tile_of_block(pass);
    const Pixel pixel(pass, tile);
    const int begin = pass.tile_ranges[2 * tile], end = pass.tile_done[tile];
    const float first_inverse_z = first_inverse_depth(pass, begin, end);
    BackwardPixel p = load_pixel(pass, pixel);
    if (pass.tile_background) background_gradient(pass, tile, p, pixel.inside, background_part);
    for (int base = begin; base < end; base += kTileThreads) {
        unsigned slot = 0, hits = 0;
        if (base + t < end) {
            slot = pass.sorted_slots[base + t];
            hits = pass.hits[slot];
        }
        const unsigned some = __ballot_sync(kAllLanes, hits != 0);
        __syncthreads();
        if (lane == 0) counts[warp] = __popc(some);
        __syncthreads();
        int place = __popc(some & ((1u << lane) - 1)), total = 0;
        for (int w = 0; w < kWarps; ++w) {
            if (w < warp) place += static_cast<int>(counts[w]);
            total += static_cast<int>(counts[w]);
        }
        if (hits != 0) {
            listed_slot[place] = slot;
            listed_hits[place] = hits;
        }
        __syncthreads();
        for (int first = 0; first < total; first += kSub) {
            const int count = total - first < kSub ? total - first : kSub;
            if (t < count) {
                const int m = static_cast<int>(pass.slot_triangle[listed_slot[first + t]]);
                stage(pass, staged[t], load_record(pass, m), m);
            }
            __syncthreads();
            unsigned todo = __ballot_sync(kAllLanes, lane < count && (listed_hits[first + (lane < count ? lane : 0)] >> warp & 1));
            for (; todo != 0; todo &= todo - 1) {
                const int k = __ffs(static_cast<int>(todo)) - 1;
                float sums[kStride] = {};
                differentiate(pass, staged[k], pixel, first_inverse_z, p, sums);
#pragma unroll
                for (int j = 0; j < kStride; j += 16) {
                    const float sum = sum_sixteen(sums + j);
                    if (lane % 2 == 0) warp_sums[warp][k][j + lane / 2] = sum;
                }
            }
            __syncthreads();
            for (int i = t; i < count * kStride; i += kTileThreads) {
                const int k = i / kStride, j = i % kStride;
                float sum = 0.0f;
                for (unsigned bits = listed_hits[first + k]; bits != 0; bits &= bits - 1)
                    sum += warp_sums[__ffs(static_cast<int>(bits)) - 1][k][j];
                pass.slot_sums[static_cast<long long>(listed_slot[first + k]) * kStride + j] = sum;
            }
        }
    }
}
