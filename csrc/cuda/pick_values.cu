// To each pixel the value of the triangle that it shows, and the sums of the pixels' gradients by triangle. 8 bytes a pixel
// forward, 16 backward and 8 atomic in the L2 cache; bytes bound both. Sums are of integers: the same bits in any order.
#include "cuda/fixed_sums.h"

using namespace etsplat;

// Grid: (blocks of a view, views). values (B, N), chosen (B, P): 0 for none, or the triangle's number plus 1.
__device__ long long picked(const int* chosen, long long pixels, long long triangles, long long& pixel) {
    pixel = static_cast<long long>(blockIdx.x) * blockDim.x + threadIdx.x;
    if (pixel >= pixels) return -1;
    pixel += blockIdx.y * pixels;
    return chosen[pixel] > 0 && chosen[pixel] <= triangles ? blockIdx.y * triangles + chosen[pixel] - 1 : -1;
}

extern "C" __global__ void pick_forward(const float* values, const int* chosen, long long pixels, long long triangles,
                                        float* image) {
    long long pixel;
    const long long at = picked(chosen, pixels, triangles, pixel);
    if (static_cast<long long>(blockIdx.x) * blockDim.x + threadIdx.x < pixels) image[pixel] = at < 0 ? 0.0f : values[at];
}

// Whole warps: lanes past the end have nothing.
extern "C" __global__ void pick_largest(const float* grad_image, const int* chosen, long long pixels,
                                        long long triangles, unsigned* largest) {
    long long pixel;
    const long long at = picked(chosen, pixels, triangles, pixel);
    record_largest(at < 0 ? 0.0f : fabsf(grad_image[pixel]), largest);
}

extern "C" __global__ void pick_add(const float* grad_image, const int* chosen, long long pixels, long long triangles,
                                    const unsigned* largest, FixedSum* sums) {
    long long pixel;
    const long long at = picked(chosen, pixels, triangles, pixel);
    if (at >= 0) add_fixed(sums + at, grad_image[pixel], fixed_scale(*largest));
}

extern "C" __global__ void pick_finish(const FixedSum* sums, const unsigned* largest, long long count, float* grad_values) {
    const long long i = static_cast<long long>(blockIdx.x) * blockDim.x + threadIdx.x;
    if (i < count) grad_values[i] = from_fixed(sums[i], *largest);
}
