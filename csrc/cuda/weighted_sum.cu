// The value of an objective from its terms, and what its gradient is by each of them; one thread does it all. In torch these
// were some twenty launches of a few microseconds.
constexpr int kMaxTerms = 6;

struct WeightedTerms {
    const float* values[kMaxTerms];
    float weights[kMaxTerms];
    int powers[kMaxTerms];  // 1, -1 or -2
    int count;
};

__device__ float power_of(float value, int power) {
    return power == 1 ? value : power == -1 ? 1.0f / value : 1.0f / (value * value);
}

// *first + *scale sum_k weight_k value_k^power_k; `scale` null for 1.
extern "C" __global__ void weighted_sum(const float* first, WeightedTerms terms, const float* scale, float* sum) {
    float total = 0.0f;
#pragma unroll  // so that no index is a variable
    for (int k = 0; k < kMaxTerms; ++k) {
        if (k < terms.count) total += terms.weights[k] * power_of(*terms.values[k], terms.powers[k]);
    }
    *sum = *first + (scale ? *scale : 1.0f) * total;
}

// gradients (1 + count): by `first`, then by each value.
extern "C" __global__ void weighted_sum_backward(WeightedTerms terms, const float* scale, const float* grad_sum,
                                                 float* gradients) {
    gradients[0] = *grad_sum;
    const float scaled = *grad_sum * (scale ? *scale : 1.0f);
#pragma unroll
    for (int k = 0; k < kMaxTerms; ++k) {
        if (k >= terms.count) continue;
        const int power = terms.powers[k];
        const float slope = power == 1 ? 1.0f : static_cast<float>(power) * power_of(*terms.values[k], power) / *terms.values[k];
        gradients[1 + k] = scaled * terms.weights[k] * slope;
    }
}
