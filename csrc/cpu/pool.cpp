#include "pool.h"

#include <algorithm>
#include <cstdint>
#include <iterator>
#include <mutex>
#include <unordered_map>
#include <vector>

#include "forking.h"
#include "huge_pages.h"

namespace etsplat {
namespace {

constexpr std::size_t kMostIdleBytes = std::size_t{256} << 20;
constexpr std::uint64_t kLately = 1000;  // blocks that came back since: some tens of steps, or views of an evaluation

std::mutex mutex;
const LockedWhileForking<mutex> whole_in_children;

struct Idle {
    float* block;
    std::size_t count;  // floats in it
    std::uint64_t since;
};

struct Pool {
    std::vector<Idle> idle;  // those that came back first in front
    std::unordered_map<float*, std::size_t> size;
    std::size_t idle_bytes = 0;
    std::uint64_t returned = 0;  // blocks, ever

    void forget(std::vector<Idle>::iterator which) noexcept {
        const auto [block, count, _] = *which;
        idle.erase(which);
        idle_bytes -= count * sizeof(float);
        size.erase(block);
        release_block(block, count * sizeof(float));
    }
};

Pool& pool() {
    static Pool* instance = new Pool;  // outlives every tensor
    return *instance;
}

}  // namespace

// The smallest block that is large enough, unless a quarter of it would lie idle; of those the last that came back.
float* pool_acquire(std::size_t count) {
    Pool& p = pool();
    std::lock_guard lock(mutex);
    auto best = p.idle.rend();
    for (auto it = p.idle.rbegin(); it != p.idle.rend(); ++it)
        if (it->count >= count && it->count - count <= it->count / 4 && (best == p.idle.rend() || it->count < best->count))
            best = it;
    if (best != p.idle.rend()) {
        float* block = best->block;
        p.idle_bytes -= best->count * sizeof(float);
        p.idle.erase(std::next(best).base());
        return block;
    }
    p.idle.reserve(p.size.size() + 1);  // so that nothing is to be allocated when it comes back
    auto* block = static_cast<float*>(acquire_block(count * sizeof(float)));
    p.size[block] = count;
    return block;
}

void pool_release(float* block) noexcept {
    Pool& p = pool();
    std::lock_guard lock(mutex);
    const std::size_t count = p.size.at(block);
    p.idle.push_back({block, count, p.returned++});
    p.idle_bytes += count * sizeof(float);
    while (p.returned - p.idle.front().since > kLately) p.forget(p.idle.begin());
    while (p.idle_bytes > kMostIdleBytes) {  // rather one large block than all small ones
        const auto smaller = [](const Idle& a, const Idle& b) { return a.count < b.count; };
        p.forget(std::max_element(p.idle.begin(), p.idle.end(), smaller));
    }
}

std::size_t pool_idle_bytes() {
    Pool& p = pool();
    std::lock_guard lock(mutex);
    return p.idle_bytes;
}

}  // namespace etsplat
