// One element of an Adam step (Kingma and Ba 2015, algorithm 1), rounded as torch.optim.Adam rounds it, also where contraction
// is on.
#pragma once

#include "portable.h"

namespace etsplat {

template <class T>
struct AdamCoefficients {
    T first_weight;       // 1 - beta1
    T second_decay;       // beta2
    T second_weight;      // 1 - beta2
    T step_size;          // learning rate / (1 - beta1^t)
    T second_correction;  // sqrt(1 - beta2^t)
    T eps;
};

// Adds the parameter `decay` times to its gradient. All is read before anything is written: nobody knows where references
// lead, so that a load behind a store waits for it.
template <class T>
ETSPLAT_FN void adam_update(T& parameter, T& first, T& second, T gradient, T decay, const AdamCoefficients<T>& k) {
    T p = parameter, m = first, v = second;
    if (decay != T(0)) gradient = gradient + vproduct(decay, p);
    m = m + vproduct(k.first_weight, gradient - m);
    v = vproduct(v, k.second_decay) + vproduct(k.second_weight * gradient, gradient);
    p = p - vproduct(k.step_size, m / (vsqrt(v) / k.second_correction + k.eps));
    parameter = p;
    first = m;
    second = v;
}

}  // namespace etsplat
