#include "parallel.h"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdlib>
#include <exception>
#include <mutex>
#include <new>
#include <thread>
#include <vector>

#include "forking.h"

#if defined(__linux__)
#include <sched.h>
#endif
#if defined(__x86_64__) || defined(_M_X64)
#include <immintrin.h>
#endif

namespace etsplat {
namespace {

// ETSPLAT_NUM_THREADS, where it is a positive number; else the cores this process may run on.
int default_threads() {
    const char* text = std::getenv("ETSPLAT_NUM_THREADS");
    if (const int threads = text ? std::atoi(text) : 0; threads > 0) return threads;
#if defined(__linux__)
    cpu_set_t set;
    if (sched_getaffinity(0, sizeof set, &set) == 0) return std::max(1, CPU_COUNT(&set));
#endif
    return std::max(1u, std::thread::hardware_concurrency());
}

inline void pause_briefly() {
#if defined(__x86_64__) || defined(_M_X64)
    _mm_pause();
#endif
}

thread_local bool inside_parallel_region = false;

struct Job {
    const RangeBody* body = nullptr;
    int64_t n = 0, grain = 1;
    std::atomic<int64_t> next{0};
    std::atomic<bool> failed{false};
    std::exception_ptr error;

    void run() {
        inside_parallel_region = true;
        for (;;) {
            const int64_t begin = next.fetch_add(grain, std::memory_order_relaxed);
            if (begin >= n || failed.load(std::memory_order_relaxed)) break;
            try {
                (*body)(begin, std::min(n, begin + grain));
            } catch (...) {
                if (!failed.exchange(true)) error = std::current_exception();
            }
        }
        inside_parallel_region = false;
    }
};

// Workers spin for a moment after a job, since the next stage of a render follows within microseconds, then sleep.
// A job does not wait for workers that are late (asleep, or without a processor on a busy machine): the calling thread
// takes part, closes the job when no range is left, and waits only for those who entered.
class Pool {
public:
    explicit Pool(int workers) {
        for (int i = 0; i < workers; ++i) threads_.emplace_back([this] { work(); });
    }
    ~Pool() {
        {
            std::lock_guard lock(mutex_);
            stop_ = true;
            generation_.fetch_add(1);
        }
        wake_.notify_all();
        for (auto& thread : threads_) thread.join();
    }
    int workers() const { return static_cast<int>(threads_.size()); }

    void run(Job& job) {
        job_ = &job;
        entered_.store(kOpen, std::memory_order_release);
        {
            std::lock_guard lock(mutex_);
            generation_.fetch_add(1, std::memory_order_release);
        }
        if (sleeping_.load() > 0) wake_.notify_all();
        job.run();
        entered_.fetch_and(~kOpen, std::memory_order_acq_rel);
        for (int i = 0; entered_.load(std::memory_order_acquire) != 0; ++i) {
            if (i < kSpins)
                pause_briefly();
            else
                std::this_thread::yield();
        }
    }

private:
    static constexpr uint32_t kOpen = 1u << 31;
    static constexpr int kSpins = 4000;

    bool enter() {
        uint32_t count = entered_.load(std::memory_order_acquire);
        while (count & kOpen)
            if (entered_.compare_exchange_weak(count, count + 1, std::memory_order_acq_rel)) return true;
        return false;
    }

    void work() {
        uint64_t seen = 0;
        for (;;) {
            for (int i = 0; i < kSpins && generation_.load(std::memory_order_acquire) == seen; ++i) pause_briefly();
            if (generation_.load(std::memory_order_acquire) == seen) {
                std::unique_lock lock(mutex_);
                sleeping_.fetch_add(1);
                wake_.wait(lock, [&] { return generation_.load(std::memory_order_relaxed) != seen; });
                sleeping_.fetch_sub(1);
            }
            seen = generation_.load(std::memory_order_acquire);
            if (stop_) return;
            if (!enter()) continue;
            job_->run();
            entered_.fetch_sub(1, std::memory_order_release);
        }
    }

    std::vector<std::thread> threads_;
    std::mutex mutex_;
    std::condition_variable wake_;
    std::atomic<uint64_t> generation_{0};
    std::atomic<uint32_t> entered_{0};  // workers inside the job, and whether more may enter
    std::atomic<int> sleeping_{0};
    Job* job_ = nullptr;
    std::atomic<bool> stop_{false};  // read by workers that wake late from a job, while the pool is being destroyed
};

struct Shared {
    std::mutex mutex;  // one parallel region at a time; other callers wait
    Pool* pool = nullptr;
};

// Never destroyed: threads may still draw while the process ends. After fork() the workers do not exist in the child, and
// the thread that held the mutex may not either: the child starts with neither, and the old pool leaks there.
Shared& shared = *new Shared;
const AfterFork renewed([] { new (&shared) Shared; });

std::atomic<int> wanted_threads{0};
std::atomic<int64_t> parallel_nanoseconds{0};

Pool& current_pool() {
    const int workers = num_threads() - 1;
    if (shared.pool && shared.pool->workers() != workers) {
        delete shared.pool;
        shared.pool = nullptr;
    }
    if (!shared.pool) shared.pool = new Pool(workers);
    return *shared.pool;
}

}  // namespace

int num_threads() {
    static std::atomic<int> by_default{0};  // no lock, which a child of fork() could find taken
    if (const int wanted = wanted_threads.load(); wanted > 0) return wanted;
    if (by_default == 0) by_default = default_threads();
    return by_default;
}

void set_num_threads(int n) { wanted_threads = n; }

void parallel_for(int64_t n, int64_t grain, const RangeBody& body) {
    if (n <= 0) return;
    grain = std::max<int64_t>(1, grain);
    if (inside_parallel_region) {
        body(0, n);
        return;
    }
    const auto start = std::chrono::steady_clock::now();
    Job job;
    job.body = &body;
    job.n = n;
    job.grain = grain;
    {
        std::lock_guard lock(shared.mutex);
        if (n <= grain || num_threads() == 1) {
            job.run();
        } else {
            current_pool().run(job);
        }
    }
    if (job.error) std::rethrow_exception(job.error);
    if (n <= grain) return;  // one range cannot be shared: serial work
    parallel_nanoseconds += std::chrono::nanoseconds(std::chrono::steady_clock::now() - start).count();
}

double parallel_seconds() { return 1e-9 * static_cast<double>(parallel_nanoseconds.load()); }
void reset_parallel_seconds() { parallel_nanoseconds = 0; }

}  // namespace etsplat
