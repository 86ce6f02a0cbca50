// The end of a step that runs without the host: one thread decides whether the step counts. It does not where the
// rasterizer's buffers were too small (`overflow` is not 0) or where the loss is not finite. Then `halted` keeps whatever
// follows from changing anything, in this step and in all that are queued behind it, and `position` stays, until the host
// has looked and clears it.
extern "C" __global__ void step_verdict(const float* loss, const long long* overflow, long long* position, float* losses,
                                        int* halted) {
    if (*halted) return;
    const bool fits = !overflow || *overflow == 0;
    const bool counts = fits && *loss - *loss == 0.0f;
    if (fits) losses[*position] = *loss;
    if (counts) *position += 1;
    *halted = counts ? 0 : 1;
}
