// Statistics of a soup's triangles after another view, one thread each. 28 bytes read and 16 written bound it.
#include "cuda/common.h"
#include "math/soup_statistics.h"

using namespace etsplat;

// The view's (N) max_weight, screen_size and inradius go into the (N) records, unless `halted` is not 0.
extern "C" __global__ void soup_statistics(int triangles, const float* max_weight, const float* view_screen_size,
                                           const float* inradius, float* importance, float* screen_size, int* seen,
                                           int* trial, int views, const float* epoch_starts, const int* halted) {
    const int n = blockIdx.x * blockDim.x + threadIdx.x;
    if (n >= triangles || *halted) return;
    const SoupRecord before{importance[n], screen_size[n], seen[n], trial[n]};
    const SoupRecord record =
        after_view(before, max_weight[n], view_screen_size[n], inradius[n], views, *epoch_starts != 0.0f);
    importance[n] = record.importance;
    screen_size[n] = record.screen_size;
    seen[n] = record.seen;
    trial[n] = record.trial;
}
