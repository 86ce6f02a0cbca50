#include "pool.h"

#include <iterator>
#include <map>
#include <mutex>
#include <unordered_map>

#include "forking.h"
#include "huge_pages.h"

namespace etsplat {
namespace {

constexpr std::size_t kMostIdleBytes = std::size_t{256} << 20;

std::mutex mutex;
const LockedWhileForking<mutex> whole_in_children;

struct Pool {
    std::multimap<std::size_t, float*> idle;  // by size in floats
    std::unordered_map<float*, std::size_t> size;
    std::size_t idle_bytes = 0;
};

Pool& pool() {
    static Pool* instance = new Pool;  // outlives every tensor
    return *instance;
}

}  // namespace

float* pool_acquire(std::size_t count) {
    Pool& p = pool();
    std::lock_guard lock(mutex);
    const auto found = p.idle.find(count);
    if (found != p.idle.end()) {
        float* block = found->second;
        p.idle.erase(found);
        p.idle_bytes -= count * sizeof(float);
        return block;
    }
    auto* block = static_cast<float*>(acquire_block(count * sizeof(float)));
    p.size[block] = count;
    return block;
}

void pool_release(float* block) noexcept {
    Pool& p = pool();
    std::lock_guard lock(mutex);
    const std::size_t count = p.size.at(block);
    p.idle.emplace(count, block);
    p.idle_bytes += count * sizeof(float);
    while (p.idle_bytes > kMostIdleBytes) {  // the largest goes first
        const auto largest = std::prev(p.idle.end());
        const std::size_t bytes = largest->first * sizeof(float);
        p.idle_bytes -= bytes;
        p.size.erase(largest->second);
        release_block(largest->second, bytes);
        p.idle.erase(largest);
    }
}

std::size_t pool_idle_bytes() {
    Pool& p = pool();
    std::lock_guard lock(mutex);
    return p.idle_bytes;
}

}  // namespace etsplat
