// The pool of threads, the pool of memory and the tile loops: tests/native/run.sh races [SECONDS], with ThreadSanitizer,
// and tests/native/run.sh forks [SECONDS] without.
//
// Threads draw side by side, take and give back memory, and change how many threads there are; the process forks
// meanwhile, and its children draw. Every picture and gradient has the bits of the first, which one thread drew alone.
// A race ends the program with status 66, a child that hangs or fails with 1. A second argument plants a race.
//
// ThreadSanitizer's own allocator is locked in a child of fork() if another thread was in it (seen with GCC 12, in one or
// two of a hundred children): there, one child in ten may hang. Without it none may.
#include <sys/wait.h>
#include <unistd.h>

#include <atomic>
#include <chrono>
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <stdexcept>
#include <thread>
#include <vector>

#include "cpu/parallel.h"
#include "cpu/pool.h"
#include "scene.h"

using namespace etsplat;
using namespace etsplat::scene;

namespace {

constexpr int kDrawing = 3;         // threads that draw
constexpr unsigned kPatience = 60;  // seconds that a child may take
#if defined(__SANITIZE_THREAD__)
constexpr int kHangOneIn = 10;
#else
constexpr int kHangOneIn = 0;  // none
#endif
constexpr int kKernel = 2;          // any of them

bool same(const std::vector<float>& a, const std::vector<float>& b) {
    return a.size() == b.size() && std::memcmp(a.data(), b.data(), a.size() * sizeof(float)) == 0;
}

bool same(const Result& a, const Result& b) {
    return same(a.color, b.color) && same(a.alpha, b.alpha) && same(a.distortion, b.distortion) &&
           same(a.median, b.median) && same(a.weights, b.weights) && same(a.vertices, b.vertices) && same(a.flat, b.flat) &&
           same(a.corner, b.corner) && same(a.opacities, b.opacities) && same(a.sigmas, b.sigmas) &&
           same(a.background, b.background) && same(a.viewmat, b.viewmat) && same(a.K, b.K);
}

struct Expected {
    std::vector<Result> results;  // of each pass

    Expected() {
        Scene scene;
        set_num_threads(1);
        for (const Pass& pass : kPasses) results.push_back(render(scene, kKernel, 0, pass));
    }

    bool drawn_again() const {
        Scene scene;
        for (size_t i = 0; i < results.size(); ++i)
            if (!same(render(scene, kKernel, 0, kPasses[i]), results[i])) return false;
        return true;
    }
};

// Blocks of a few sizes, written from end to end while they are ours.
bool memory_is_ours() {
    std::vector<std::pair<float*, size_t>> blocks;
    for (size_t i = 0; i < 8; ++i) blocks.emplace_back(pool_acquire(1000 * (1 + i % 3)), 1000 * (1 + i % 3));
    for (size_t i = 0; i < blocks.size(); ++i) std::fill_n(blocks[i].first, blocks[i].second, static_cast<float>(i));
    bool ours = pool_idle_bytes() < (size_t{1} << 40);
    for (size_t i = 0; i < blocks.size(); ++i) {
        for (size_t k = 0; k < blocks[i].second; ++k) ours = ours && blocks[i].first[k] == static_cast<float>(i);
        pool_release(blocks[i].first);
    }
    return ours;
}

// An exception in a range comes out of the call, whoever ran the range.
bool exceptions_come_out() {
    try {
        parallel_for(100, 1, [](int64_t begin, int64_t) {
            if (begin == 50) throw std::runtime_error("fifty");
        });
    } catch (const std::runtime_error&) {
        return true;
    }
    return false;
}

enum class Child { drew, hung, failed };

// Whether a child of this process, as it is now, can do all of it.
Child a_child_draws(const Expected& expected) {
    const pid_t child = fork();
    if (child == 0) {
        alarm(kPatience);
        set_num_threads(2);
        _exit(expected.drawn_again() && memory_is_ours() ? 0 : 1);
    }
    int status = 0;
    waitpid(child, &status, 0);
    if (WIFSIGNALED(status)) std::printf("a child got signal %d\n", WTERMSIG(status));
    if (WIFSIGNALED(status) && WTERMSIG(status) == SIGALRM) return Child::hung;
    return WIFEXITED(status) && WEXITSTATUS(status) == 0 ? Child::drew : Child::failed;
}

}  // namespace

int main(int argc, char** argv) {
    const auto until = std::chrono::steady_clock::now() + std::chrono::seconds(argc > 1 ? std::atoi(argv[1]) : 20);
    const Expected expected;
    std::atomic<bool> stop{false}, wrong{false};
    std::atomic<int> drawn{0}, resized{0};
    const bool plant = argc > 2;
    int planted = 0;
    std::vector<std::thread> threads;
    set_num_threads(3);
    for (int i = 0; i < kDrawing; ++i)
        threads.emplace_back([&] {
            while (!stop) {
                if (!expected.drawn_again() || !memory_is_ours() || !exceptions_come_out()) wrong = true;
                ++drawn;
                if (plant) ++planted;
            }
        });
    threads.emplace_back([&] {
        for (int i = 0; !stop; ++i) {
            set_num_threads(1 + i % 4);
            ++resized;
            std::this_thread::sleep_for(std::chrono::milliseconds(1));
        }
    });
    int forked = 0, hung = 0;
    while ((std::chrono::steady_clock::now() < until || forked == hung) && !wrong) {
        std::this_thread::sleep_for(std::chrono::milliseconds(10 * (forked % 4)));
        const Child child = a_child_draws(expected);
        ++forked;
        if (child == Child::hung) ++hung;
        if (child == Child::failed || hung * kHangOneIn > forked + kHangOneIn || (hung > 0 && kHangOneIn == 0)) wrong = true;
    }
    stop = true;
    for (std::thread& thread : threads) thread.join();
    std::printf("%d times drawn, %d times another number of threads, %d children, %d of them hung%s\n", drawn.load(),
                resized.load(), forked, hung, wrong ? ": WRONG" : "");
    return wrong || drawn == 0 || resized == 0 || forked == 0 ? 1 : 0;
}
