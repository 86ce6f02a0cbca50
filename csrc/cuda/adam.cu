// Adam on all parameters in one launch. Each block belongs to one parameter and updates kElements of its elements; the
// parameters' addresses come with the launch, by value. Rates come from device memory, so that a captured launch can be
// repeated with others. Per element 16 bytes are read and 12 written, and that bounds it.
#include "math/adam.h"

using namespace etsplat;

constexpr int kThreads = 256;
constexpr int kElements = 4 * kThreads;  // of a block
constexpr int kMaxParameters = 8;        // of a launch

struct AdamParameters {
    float* values[kMaxParameters];
    const float* gradients[kMaxParameters];
    float* firsts[kMaxParameters];
    float* seconds[kMaxParameters];
    const float* paces[kMaxParameters];  // of rows, or null
    long long sizes[kMaxParameters];
    int widths[kMaxParameters];  // elements of a row
};

// step_sizes: for each parameter learning rate / (1 - beta1^t); second_correction: sqrt(1 - beta2^t); decays: how many times
// each is added to its gradient, or null. Where `halted` is given and not 0, nothing is updated.
extern "C" __global__ void adam_step(AdamParameters parameters, int count, const float* step_sizes,
                                     const float* second_correction, const float* decays, float first_weight,
                                     float second_decay, float second_weight, float eps, const int* halted) {
    if (halted && *halted) return;
    long long block = blockIdx.x;
    int p = 0;
    for (; p < count; ++p) {
        const long long blocks = (parameters.sizes[p] + kElements - 1) / kElements;
        if (block < blocks) break;
        block -= blocks;
    }
    AdamCoefficients<float> k{first_weight, second_decay, second_weight, step_sizes[p], *second_correction, eps};
    const float step_size = k.step_size, decay = decays ? decays[p] : 0.0f, *pace = parameters.paces[p];
    float *value = parameters.values[p], *first = parameters.firsts[p], *second = parameters.seconds[p];
    const float* gradient = parameters.gradients[p];
    const long long begin = block * kElements, left = parameters.sizes[p] - begin;
    const int width = parameters.widths[p];
    int within = 0;  // of a row with a pace: the place where the block begins
    if (pace) {
        const long long row = begin / width;
        within = static_cast<int>(begin - row * width);
        pace += row;
    }
    for (int i = threadIdx.x; i < kElements; i += kThreads) {
        if (i >= left) break;
        if (pace) k.step_size = step_size * pace[static_cast<unsigned>(within + i) / static_cast<unsigned>(width)];
        adam_update(value[begin + i], first[begin + i], second[begin + i], gradient[begin + i], decay, k);
    }
}
