// One element of an Adam step (Kingma and Ba 2015, algorithm 1), rounded as torch.optim.Adam rounds it.
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

template <class T>
ETSPLAT_FN void adam_update(T& parameter, T& first, T& second, T gradient, const AdamCoefficients<T>& k) {
    first = first + k.first_weight * (gradient - first);
    second = second * k.second_decay + k.second_weight * gradient * gradient;
    parameter = parameter - k.step_size * (first / (vsqrt(second) / k.second_correction + k.eps));
}

}  // namespace etsplat
