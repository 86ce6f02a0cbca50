// The end of a step that runs without the host: one thread decides whether the step counts. It does not where the
// rasterizer's buffers were too small (`overflow` is not 0) or where the loss is not finite; then `halted` keeps Adam from
// updating and `position` stays, so that every later repetition is the same step again, until the host looks.
extern "C" __global__ void step_verdict(const float* loss, const long long* overflow, long long* position, float* losses,
                                        int* halted) {
    const bool fits = !overflow || *overflow == 0;
    const bool counts = fits && *loss - *loss == 0.0f;
    if (fits) losses[*position] = *loss;
    if (counts) *position += 1;
    *halted = counts ? 0 : 1;
}
