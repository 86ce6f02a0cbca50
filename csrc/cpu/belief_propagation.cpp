#include "belief_propagation.h"

#include <algorithm>
#include <vector>

#include "parallel.h"

namespace etsplat {
namespace {

constexpr int64_t kNodes = 64, kMessages = 64;  // that a thread takes at a time

// A message along each edge, in both directions: those from its first end, then those from its second.
struct Messages {
    const int64_t* edges;
    int64_t E;

    int64_t count() const { return 2 * E; }
    int64_t source(int64_t m) const { return m < E ? edges[2 * m] : edges[2 * (m - E) + 1]; }
    int64_t target(int64_t m) const { return m < E ? edges[2 * m + 1] : edges[2 * (m - E)]; }
    int64_t back(int64_t m) const { return m < E ? m + E : m - E; }
};

// The messages to each node, in their order: those of node n are incoming[first[n]] to incoming[first[n + 1] - 1].
struct Incoming {
    std::vector<int64_t> first, messages;

    Incoming(const Messages& all, int64_t N) : first(N + 1), messages(all.count()) {
        for (int64_t m = 0; m < all.count(); ++m) ++first[all.target(m) + 1];
        for (int64_t n = 0; n < N; ++n) first[n + 1] += first[n];
        std::vector<int64_t> next(first.begin(), first.end() - 1);
        for (int64_t m = 0; m < all.count(); ++m) messages[next[all.target(m)]++] = m;
    }
};

// What a node sends: of each label the least of what the source believes, less what the target told it, with the edge's cost.
void send(const float* belief, const float* told, const float* before, int64_t D, const LabelCosts& costs, float* message) {
    for (int64_t k = 0; k < D; ++k) message[k] = belief[k] - told[k];
    const float least = *std::min_element(message, message + D);
    for (int64_t k = 1; k < D; ++k) message[k] = std::min(message[k], message[k - 1] + costs.bend);
    for (int64_t k = D - 2; k >= 0; --k) message[k] = std::min(message[k], message[k + 1] + costs.bend);
    for (int64_t k = 0; k < D; ++k) {
        message[k] = (before[k] + std::min(message[k], least + costs.tear) - least) / 2.0f;
    }
}

}  // namespace

void propagate_beliefs(const float* cost, int64_t N, int64_t D, const int64_t* edges, int64_t E, const LabelCosts& costs,
                       int64_t rounds, float* belief) {
    const Messages all{edges, E};
    const Incoming incoming(all, N);
    std::vector<float> messages(static_cast<size_t>(all.count() * D)), following(messages.size());
    const auto believe = [&] {
        parallel_for(N, kNodes, [&](int64_t begin, int64_t end) {
            for (int64_t n = begin; n < end; ++n) {
                float* sum = belief + n * D;
                std::copy(cost + n * D, cost + (n + 1) * D, sum);
                for (int64_t i = incoming.first[n]; i < incoming.first[n + 1]; ++i) {
                    const float* message = messages.data() + incoming.messages[i] * D;
                    for (int64_t k = 0; k < D; ++k) sum[k] += message[k];
                }
            }
        });
    };
    for (int64_t round = 0; round < rounds; ++round) {
        believe();
        parallel_for(all.count(), kMessages, [&](int64_t begin, int64_t end) {
            for (int64_t m = begin; m < end; ++m) {
                send(belief + all.source(m) * D, messages.data() + all.back(m) * D, messages.data() + m * D, D, costs,
                     following.data() + m * D);
            }
        });
        std::swap(messages, following);
    }
    believe();
}

}  // namespace etsplat
