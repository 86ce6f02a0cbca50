// Statistics of a soup's triangles after another view (etsplat/ops/soup_statistics.py), one thread each. 28 bytes read and 16
// written bound it.
constexpr float kVisibleInradius = 1.0f;  // pixels

// The view's (N) max_weight, screen_size and inradius go into the (N) records, unless `halted` is not 0. A trial lasts `views`
// views and begins with an epoch.
extern "C" __global__ void soup_statistics(int triangles, const float* max_weight, const float* view_screen_size,
                                           const float* inradius, float* importance, float* screen_size, int* seen,
                                           int* trial, int views, const float* epoch_starts, const int* halted) {
    const int n = blockIdx.x * blockDim.x + threadIdx.x;
    if (n >= triangles || *halted) return;
    if (max_weight[n] > importance[n]) importance[n] = max_weight[n];
    if (view_screen_size[n] > screen_size[n]) screen_size[n] = view_screen_size[n];
    if (trial[n] < views && (*epoch_starts != 0.0f || trial[n] > 0)) {
        if (inradius[n] > kVisibleInradius) seen[n] += 1;
        trial[n] += 1;
    }
}
