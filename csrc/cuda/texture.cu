// Sampling of textures (csrc/math/texture.h), one sample a thread, with gradients. Gradients of texels are fixed-point
// sums (fixed_sums.h), the same bits in every run; then each texel of level 0 gathers those of the levels above it.
// Forward some 20 bytes a sample besides texels, which neighbours share; atomics in L2, 4 a level and channel, bound the
// backward.
#include "cuda/fixed_sums.h"
#include "math/texture.h"

using namespace etsplat;

struct Samples {
    const float *uv, *lod;  // lod may be null: level 0
    long long count;
};

__device__ long long thread_index() { return static_cast<long long>(blockIdx.x) * kBlock + threadIdx.x; }
__device__ float detail_of(const Samples& samples, long long n) { return samples.lod ? samples.lod[n] : 0.0f; }

// One level from the one before, a thread for each of its texels.
extern "C" __global__ void texture_halve(Texture texture, int level, float* coarser) {
    const long long i = thread_index();
    const int channels = texture.channels;
    const long long width = texture.width >> level, height = texture.height >> level;
    if (i >= width * height) return;
    const float* from = level_texels(texture, level - 1) + (4 * (i / width) * width + 2 * (i % width)) * channels;
    float* to = coarser + (coarser_offset(texture.width, texture.height, level) + i) * channels;
    for (int c = 0; c < channels; ++c) {
        const float* lower = from + 2 * width * channels;
        to[c] = texel_mean(from[c], from[channels + c], lower[c], lower[channels + c]);
    }
}

extern "C" __global__ void texture_sample(Texture texture, Samples samples, float* values) {
    const long long n = thread_index();
    if (n >= samples.count) return;
    sample_texture(texture, samples.uv[2 * n], samples.uv[2 * n + 1], detail_of(samples, n),
                   values + n * texture.channels);
}

extern "C" __global__ void texture_by_uv(Texture texture, Samples samples, const float* grad_values, float* grad_uv) {
    const long long n = thread_index();
    if (n >= samples.count) return;
    sample_texture_backward(texture, samples.uv[2 * n], samples.uv[2 * n + 1], detail_of(samples, n),
                            grad_values + n * texture.channels, grad_uv + 2 * n);
}

// Weights are 1 at most, and those of a sample in one level add up to no more.
extern "C" __global__ void texture_measure(const float* grad_values, long long count, unsigned* largest) {
    const long long i = thread_index();
    record_largest(i < count ? fabsf(grad_values[i]) : 0.0f, largest);
}

// base and coarser are laid out like the texture's.
extern "C" __global__ void texture_scatter(Texture texture, Samples samples, const float* grad_values,
                                           const unsigned* largest, FixedSum* base, FixedSum* coarser) {
    const long long n = thread_index();
    if (n >= samples.count) return;
    const double scale = fixed_scale(*largest);
    const int channels = texture.channels;
    const Levels levels = find_levels(texture, detail_of(samples, n));
    for (int i = 0; i < levels.count; ++i) {
        const LevelSample sample = sample_level(texture, levels, i, samples.uv[2 * n], samples.uv[2 * n + 1]);
        FixedSum* sums = base;
        if (sample.level > 0) sums = coarser + coarser_offset(texture.width, texture.height, sample.level) * channels;
        float w[4];
        long long at[4];
        sample.weights(w);
        sample.places(texture.width >> sample.level, at);
        for (int k = 0; k < 4; ++k) {
            for (int c = 0; c < channels; ++c) {
                add_fixed(sums + at[k] * channels + c, static_cast<double>(w[k]) * grad_values[n * channels + c], scale);
            }
        }
    }
}

// A thread for each number of the texture.
extern "C" __global__ void texture_gather(Texture texture, const FixedSum* base, const FixedSum* coarser,
                                          const unsigned* largest, float* grad_texture) {
    const long long i = thread_index();
    const long long row = static_cast<long long>(texture.width) * texture.channels;
    if (i >= row * texture.height) return;
    const int c = static_cast<int>(i % texture.channels);
    const int x = static_cast<int>(i / texture.channels % texture.width), y = static_cast<int>(i / row);
    float total = from_fixed(base[i], *largest), share = 1.0f;
    for (int level = 1; level < texture.levels; ++level) {
        const long long texel = static_cast<long long>(y >> level) * (texture.width >> level) + (x >> level);
        const long long at = coarser_offset(texture.width, texture.height, level) + texel;
        share *= 0.25f;
        total += share * from_fixed(coarser[at * texture.channels + c], *largest);
    }
    grad_texture[i] = total;
}
