// A SIMT machine on one CPU thread, for tests: CUDA C++ kernels compiled by a host compiler, unchanged.
//
// Blocks run one after another, in order; the threads of a block are fibers. A fiber runs until a barrier or a warp
// operation makes it wait, then another one goes on, its own warp first. So this finds wrong results, wrong masks, missing
// arrivals (reported as a deadlock, with who waits where) and, with sanitizers, wrong addresses. Shared memory is
// poisoned before each block. `order_seed` starts the threads in another order, which exposes some races; ThreadSanitizer,
// where it is, reports those of any order, as races.h tells it what orders memory on a device.
//
// A failure ends the launch and comes back as a message. Kernels need no change, but: shared arrays are declared in the
// kernel itself and not in templates, and kernels are extern "C".
#pragma once

#include <sys/mman.h>

#include <array>
#include <bit>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <functional>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

#ifdef __SANITIZE_ADDRESS__
#include <sanitizer/asan_interface.h>
#endif
#include "races.h"

#if !defined(__x86_64__) || defined(SIMT_UCONTEXT)
#define SIMT_USES_UCONTEXT 1
#include <ucontext.h>
#endif

#define __global__
#define __device__
#define __host__
#define __constant__ static const
#define __forceinline__ inline
#define __noinline__ __attribute__((noinline))
#define __launch_bounds__(...)
#define __grid_constant__
#define __shared__ static __attribute__((section("simt_shared")))

extern "C" char __start_simt_shared[] __attribute__((weak, visibility("hidden")));
extern "C" char __stop_simt_shared[] __attribute__((weak, visibility("hidden")));

struct uint3 { unsigned x, y, z; };
struct dim3 { unsigned x = 1, y = 1, z = 1; };

namespace simt {

constexpr unsigned kWarpSize = 32;
constexpr size_t kStackSize = 128 << 10;
constexpr size_t kMostThreads = 1024;
constexpr unsigned char kPoison = 0xff;  // NaN as a float, -1 as an int

struct Fiber {
#ifdef SIMT_USES_UCONTEXT
    ucontext_t context;
#else
    void* stack_pointer = nullptr;
#endif
    uint3 thread{};
    unsigned index = 0;
    bool done = false;
    const unsigned* awaited = nullptr;  // a generation counter; the fiber goes on when it is no longer `seen`
    unsigned seen = 0;
    const char* operation = "";
    unsigned mask = 0;
    unsigned exchanges = 0;
    void* context_of_races = nullptr;

    unsigned lane() const { return index % kWarpSize; }
    bool runnable() const { return !done && (!awaited || *awaited != seen); }
};

// Lanes that meet in one warp operation.
struct Meeting {
    unsigned mask = 0, arrived = 0, generation = 0;
    const char* operation = "";
};

struct Warp {
    uint64_t values[2][kWarpSize];  // alternating, so that a lane may go on before the others have read
    Meeting meetings[kWarpSize];
    int count = 0;
    unsigned exited = 0;
};

struct Machine {
    uint3 block{};
    dim3 block_size, grid_size;
    std::vector<Fiber> fibers;
    std::vector<Warp> warps;
    std::function<void()> kernel;
    std::string failure;
    Fiber host;
    Fiber* current = nullptr;
    unsigned alive = 0;
    // of __syncthreads
    unsigned arrived = 0, generation = 0;
    int count = 0, result = 0;
    char* stacks = nullptr;
    unsigned order_seed = 0;
};

inline Machine machine;

#ifndef SIMT_USES_UCONTEXT
extern "C" __attribute__((visibility("hidden"))) void simt_switch(void** save, void* restore);
asm(R"(
.pushsection .text
.hidden simt_switch
.weak simt_switch
.type simt_switch,@function
simt_switch:
 pushq %rbp; pushq %rbx; pushq %r12; pushq %r13; pushq %r14; pushq %r15
 movq %rsp, (%rdi)
 movq %rsi, %rsp
 popq %r15; popq %r14; popq %r13; popq %r12; popq %rbx; popq %rbp
 ret
.popsection
)");
#endif

SIMT_MACHINE void switch_to(Fiber& next) {
    Fiber& self = *machine.current;
    if (&self == &next) return;
    machine.current = &next;
    races::switch_to(next.context_of_races);
#ifdef SIMT_USES_UCONTEXT
    swapcontext(&self.context, &next.context);
#else
    simt_switch(&self.stack_pointer, next.stack_pointer);
#endif
}

// Ends the launch; the fibers are left where they are and their stacks used again.
[[noreturn]] SIMT_MACHINE void fail(const std::string& what) {
    const uint3 b = machine.block;
    machine.failure = what + " in block (" + std::to_string(b.x) + ", " + std::to_string(b.y) + ", " +
                      std::to_string(b.z) + ")";
    const Fiber* listed = nullptr;  // one line for neighbours that wait for the same
    for (const Fiber& fiber : machine.fibers) {
        if (fiber.done || !fiber.awaited) continue;
        if (listed && listed->operation == fiber.operation && listed->mask == fiber.mask) continue;
        listed = &fiber;
        char line[160];
        snprintf(line, sizeof line, "\n  from thread (%u, %u, %u) on: waiting in %s, mask %08x", fiber.thread.x,
                 fiber.thread.y, fiber.thread.z, fiber.operation, fiber.mask);
        machine.failure += line;
    }
    switch_to(machine.host);
    __builtin_unreachable();
}

// Lets another fiber run: of the same warp if one can, else of the block. Returns when this one is chosen again.
SIMT_MACHINE void give_way() {
    Machine& m = machine;
    const unsigned self = m.current->index, total = static_cast<unsigned>(m.fibers.size());
    const unsigned base = self / kWarpSize * kWarpSize, lanes = std::min(kWarpSize, total - base);
    for (unsigned k = 1; k <= lanes; ++k) {
        Fiber& next = m.fibers[base + (self - base + k) % lanes];
        if (next.runnable()) return switch_to(next);
    }
    for (unsigned k = 1; k < total; ++k) {
        Fiber& next = m.fibers[(self + k) % total];
        if (next.runnable()) return switch_to(next);
    }
    if (m.alive == 0) return switch_to(m.host);
    fail("deadlock");
}

SIMT_MACHINE void wait_for(const unsigned& generation, const char* operation, unsigned mask) {
    Fiber& self = *machine.current;
    self.awaited = &generation;
    self.seen = generation;
    self.operation = operation;
    self.mask = mask;
    while (generation == self.seen) give_way();
    self.awaited = nullptr;
}

SIMT_MACHINE void release_barrier() {
    machine.arrived = 0;
    machine.result = machine.count;
    machine.count = 0;
    ++machine.generation;
}

// Number of threads of the block with the predicate, when all that have not ended are here.
SIMT_MACHINE int barrier(bool predicate, const char* operation) {
    machine.count += predicate;
    races::Order order = races::of_block(machine.generation);
    if (++machine.arrived == machine.alive)
        release_barrier();
    else
        wait_for(machine.generation, operation, 0);
    order.joined();
    return machine.result;
}

// Values of the lanes in the mask, when all of them are here.
SIMT_MACHINE const uint64_t* exchange(unsigned mask, uint64_t value, const char* operation, bool orders_memory = false) {
    Fiber& self = *machine.current;
    Warp& warp = machine.warps[self.index / kWarpSize];
    if (!(mask >> self.lane() & 1)) fail(std::string(operation) + ": the calling lane is not in its mask");
    if (mask & warp.exited) fail(std::string(operation) + ": a lane of the mask has ended");
    const unsigned first = self.index - self.lane(), lanes = static_cast<unsigned>(machine.fibers.size()) - first;
    if (lanes < kWarpSize && mask >> lanes) fail(std::string(operation) + ": the mask names lanes that do not exist");
    Meeting* meeting = nullptr;
    for (int i = 0; i < warp.count; ++i)
        if (warp.meetings[i].mask == mask) meeting = &warp.meetings[i];
    for (int i = 0; i < warp.count && !meeting; ++i)
        if (warp.meetings[i].arrived == 0) meeting = &warp.meetings[i];
    if (!meeting) meeting = &warp.meetings[warp.count++];
    if (meeting->arrived != 0 && strcmp(meeting->operation, operation) != 0)
        fail(std::string(operation) + " meets " + meeting->operation);
    meeting->mask = mask;
    meeting->operation = operation;
    const unsigned parity = self.exchanges++ % 2;
    uint64_t* values = warp.values[parity];
    values[self.lane()] = value;
    meeting->arrived |= 1u << self.lane();
    races::Order order = races::of_lanes(orders_memory, self.index / kWarpSize, meeting - warp.meetings, meeting->generation);
    if (meeting->arrived == mask) {
        meeting->arrived = 0;
        ++meeting->generation;
    } else {
        wait_for(meeting->generation, operation, mask);
    }
    order.joined();
    return values;
}

SIMT_MACHINE void end_thread() {
    Machine& m = machine;
    Fiber& self = *m.current;
    self.done = true;
    races::thread_ends();
    --m.alive;
    Warp& warp = m.warps[self.index / kWarpSize];
    warp.exited |= 1u << self.lane();
    for (int i = 0; i < warp.count; ++i)
        if (warp.meetings[i].arrived != 0 && warp.meetings[i].mask >> self.lane() & 1)
            fail(std::string(warp.meetings[i].operation) + ": a lane of the mask has ended");
    if (m.alive > 0 && m.arrived == m.alive) release_barrier();
}

SIMT_MACHINE void run_thread() {
    races::thread_begins();
    machine.kernel();
    end_thread();
    for (;;) give_way();
}

SIMT_MACHINE void prepare(Fiber& fiber, unsigned index) {
    const dim3 size = machine.block_size;
    fiber = Fiber();
    fiber.index = index;
    fiber.context_of_races = races::context(index);
    fiber.thread = {index % size.x, index / size.x % size.y, index / (size.x * size.y)};
    char* stack = machine.stacks + (races::set_of_block() * kMostThreads + index) * kStackSize;
#ifdef SIMT_USES_UCONTEXT
    getcontext(&fiber.context);
    fiber.context.uc_stack.ss_sp = stack;
    fiber.context.uc_stack.ss_size = kStackSize;
    fiber.context.uc_link = nullptr;
    makecontext(&fiber.context, run_thread, 0);
#else
    // Staggered, so that the stacks do not share cache sets. A return address, then six saved registers.
    uintptr_t top = reinterpret_cast<uintptr_t>(stack + kStackSize - 64 - index * 192 % 8192) & ~uintptr_t{15};
#ifdef __SANITIZE_ADDRESS__
    __asan_unpoison_memory_region(reinterpret_cast<char*>(top) - 4096, 4096);  // frames that run_thread was left in
#endif
    void** slot = reinterpret_cast<void**>(top);
    *--slot = nullptr;
    *--slot = reinterpret_cast<void*>(run_thread);
    for (int i = 0; i < 6; ++i) *--slot = nullptr;
    fiber.stack_pointer = slot;
#endif
}

SIMT_MACHINE void run_block(uint3 block) {
    Machine& m = machine;
    races::machine_begins();
    m.block = block;
    const unsigned threads = m.block_size.x * m.block_size.y * m.block_size.z;
    m.fibers.resize(threads);
    m.warps.assign((threads + kWarpSize - 1) / kWarpSize, Warp());
    m.alive = threads;
    m.arrived = m.generation = 0;
    m.count = 0;
    if (__start_simt_shared) memset(__start_simt_shared, kPoison, static_cast<size_t>(__stop_simt_shared - __start_simt_shared));
    races::block_begins(__start_simt_shared, __stop_simt_shared);
    for (unsigned i = 0; i < threads; ++i) prepare(m.fibers[i], i);
    m.host.context_of_races = races::current_context();
    const unsigned first = m.order_seed == 0 ? 0 : (m.order_seed * 2654435761u + block.x * 97 + block.y * 31) % threads;
    m.current = &m.host;
    races::machine_ends();
    switch_to(m.fibers[first]);
}

// Runs the grid; nullptr, or what went wrong.
SIMT_MACHINE const char* run_grid(const unsigned* grid, const unsigned* block, std::function<void()> kernel) {
    Machine& m = machine;
    m.grid_size = {grid[0], grid[1], grid[2]};
    m.block_size = {block[0], block[1], block[2]};
    m.kernel = std::move(kernel);
    const size_t threads = size_t{block[0]} * block[1] * block[2];
    if (threads == 0 || threads > kMostThreads) return "a block has 1 to 1024 threads";
    // Never unmapped: AddressSanitizer goes on to guard what frames on them it has seen.
    if (!m.stacks)
        m.stacks = static_cast<char*>(mmap(nullptr, races::kSets * kMostThreads * kStackSize, PROT_READ | PROT_WRITE,
                                           MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0));
#ifdef __SANITIZE_ADDRESS__
    if (!m.failure.empty()) __asan_unpoison_memory_region(m.stacks, kMostThreads * kStackSize);  // frames left behind
#endif
    m.failure.clear();
    races::launch_begins();
    for (unsigned z = 0; z < grid[2]; ++z)
        for (unsigned y = 0; y < grid[1]; ++y)
            for (unsigned x = 0; x < grid[0]; ++x) {
                run_block({x, y, z});
                if (!m.failure.empty()) return m.failure.c_str();
            }
    races::launch_ends();
    return nullptr;
}

template <class... P, size_t... I>
const char* launch(void (*kernel)(P...), const unsigned* grid, const unsigned* block, void** arguments,
                   std::index_sequence<I...>) {
    return run_grid(grid, block, [=] { kernel(*static_cast<P*>(arguments[I])...); });
}
template <class... P>
const char* launch(void (*kernel)(P...), const unsigned* grid, const unsigned* block, void** arguments) {
    return launch(kernel, grid, block, arguments, std::index_sequence_for<P...>());
}

template <class Kernel>
struct Parameters;
template <class... P>
struct Parameters<void (*)(P...)> {
    static constexpr std::array<unsigned, sizeof...(P) + 1> kSizes{sizeof(P)...};  // and 0 behind
};

}  // namespace simt

// What a test calls to run a kernel, and the sizes of its parameters; the build adds these for each.
#define SIMT_EXPORT(kernel)                                                                                       \
    extern "C" {                                                                                                  \
    __attribute__((visibility("default"))) auto simt_parameters_##kernel = simt::Parameters<decltype(&kernel)>::kSizes; \
    }                                                                                                             \
    extern "C" __attribute__((visibility("default"))) const char* simt_launch_##kernel(                           \
        const unsigned* grid, const unsigned* block, void** arguments, unsigned order_seed) {                     \
        simt::machine.order_seed = order_seed;                                                                    \
        return simt::launch(kernel, grid, block, arguments);                                                      \
    }

#include "intrinsics.h"
