// Labels of least cost on a graph, by min-sum belief propagation (src/etsplat/data/hollows.py says what for).
#pragma once

#include <cstdint>

namespace etsplat {

struct LabelCosts {
    float bend;  // of an edge, for each step between the labels of its ends
    float tear;  // the most that an edge costs
};

// belief (N, D) becomes the cost (N, D) of each label plus what neighbours say of it after so many rounds, in which messages
// are damped by half. edges (E, 2). At least one label of each node has a finite cost.
void propagate_beliefs(const float* cost, int64_t N, int64_t D, const int64_t* edges, int64_t E, const LabelCosts& costs,
                       int64_t rounds, float* belief);

}  // namespace etsplat
