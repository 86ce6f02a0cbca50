// Sets a range of words to one value. One thread per word.
#include "cuda/common.h"

extern "C" __global__ void fill(unsigned* words, unsigned value, int count) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i < count) words[i] = value;
}
