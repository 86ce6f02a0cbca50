// What ThreadSanitizer is told of the machine of simt.h: its threads, and what orders memory between them.
//
// Threads of blocks that follow each other are threads of different sets, so that blocks are not ordered; a block kSets later
// has the first set again. Memory is ordered by __syncthreads*, by __syncwarp, and by the begin and the end of a launch; not by
// shuffles, votes, matches and atomics. Reads and writes that are volatile are relaxed atomics, as they are in PTX.
//
// The machine itself is not instrumented. Without -fsanitize=thread nothing of this remains.
#pragma once

#include <cstddef>
#include <vector>

#ifndef __SANITIZE_THREAD__

#define SIMT_MACHINE inline

namespace simt::races {
constexpr unsigned kSets = 1;
struct Order {
    void joined() {}
};
inline Order of_block(unsigned) { return {}; }
inline Order of_lanes(bool, size_t, size_t, unsigned) { return {}; }
inline unsigned set_of_block() { return 0; }
inline void* context(unsigned) { return nullptr; }
inline void* current_context() { return nullptr; }
inline void switch_to(void*) {}
inline void launch_begins() {}
inline void launch_ends() {}
inline void machine_begins() {}
inline void machine_ends() {}
inline void block_begins(char*, char*) {}
inline void thread_begins() {}
inline void thread_ends() {}
}  // namespace simt::races

#else

#define SIMT_MACHINE inline __attribute__((noinline, no_sanitize("thread")))

extern "C" {
void* __tsan_get_current_fiber();
void* __tsan_create_fiber(unsigned);
void __tsan_switch_to_fiber(void*, unsigned);
void __tsan_acquire(void*);
void __tsan_release(void*);
void __tsan_ignore_thread_begin();
void __tsan_ignore_thread_end();
void __tsan_java_alloc(unsigned long, unsigned long);
void __tsan_java_free(unsigned long, unsigned long);

// What GCC calls for volatile accesses is not in its library.
#define SIMT_VOLATILE(bytes, type)                                                                                     \
    inline __attribute__((used, no_sanitize("thread"))) void __tsan_volatile_read##bytes(void* p) {                    \
        __tsan_atomic##type##_load(p, 0);                                                                              \
    }                                                                                                                  \
    inline __attribute__((used, no_sanitize("thread"))) void __tsan_volatile_write##bytes(void* p) {                   \
        __tsan_atomic##type##_fetch_or(p, 0, 0);                                                                       \
    }
unsigned char __tsan_atomic8_load(const volatile void*, int);
unsigned short __tsan_atomic16_load(const volatile void*, int);
unsigned __tsan_atomic32_load(const volatile void*, int);
unsigned long __tsan_atomic64_load(const volatile void*, int);
unsigned char __tsan_atomic8_fetch_or(volatile void*, unsigned char, int);
unsigned short __tsan_atomic16_fetch_or(volatile void*, unsigned short, int);
unsigned __tsan_atomic32_fetch_or(volatile void*, unsigned, int);
unsigned long __tsan_atomic64_fetch_or(volatile void*, unsigned long, int);
SIMT_VOLATILE(1, 8)
SIMT_VOLATILE(2, 16)
SIMT_VOLATILE(4, 32)
SIMT_VOLATILE(8, 64)
}

namespace simt::races {

constexpr unsigned kSets = 3, kThreads = 1024, kWarps = 32, kMeetings = 32;

// Of all libraries of kernels together: ThreadSanitizer has room for some 8000 threads.
inline __attribute__((visibility("default"))) std::vector<void*> contexts;

struct Places {
    long block[2], lanes[kWarps][kMeetings][2];
};
inline Places places;
inline long launch_place[2];
inline unsigned block_number;

// Forgets what was read and written there, and what was ordered by it.
SIMT_MACHINE void forget(const void* begin, size_t size) {
    if (size == 0) return;
    const size_t whole = (size + 7) / 8 * 8;
    __tsan_java_free(reinterpret_cast<unsigned long>(begin), whole);
    __tsan_java_alloc(reinterpret_cast<unsigned long>(begin), whole);
}

// Of those that meet: what each did before is known to all behind. Who comes late finds what the others did before they met, and
// not what they have done since, as the next meeting has another place.
struct Order {
    void* place;
    SIMT_MACHINE void joined() {
        if (place) __tsan_acquire(place);
    }
};
SIMT_MACHINE Order at(void* place) {
    __tsan_release(place);
    return {place};
}
SIMT_MACHINE Order of_block(unsigned generation) { return at(&places.block[generation % 2]); }
SIMT_MACHINE Order of_lanes(bool orders, size_t warp, size_t meeting, unsigned generation) {
    return orders ? at(&places.lanes[warp][meeting][generation % 2]) : Order{nullptr};
}

SIMT_MACHINE unsigned set_of_block() { return block_number % kSets; }
SIMT_MACHINE void* context(unsigned thread) {
    const size_t place = set_of_block() * kThreads + thread;
    if (contexts.size() <= place) contexts.resize(kSets * kThreads);
    if (!contexts[place]) contexts[place] = __tsan_create_fiber(0);
    return contexts[place];
}
SIMT_MACHINE void* current_context() { return __tsan_get_current_fiber(); }
SIMT_MACHINE void switch_to(void* context) { __tsan_switch_to_fiber(context, 1); }  // 1: which orders nothing

SIMT_MACHINE void launch_begins() { __tsan_release(&launch_place[0]); }
SIMT_MACHINE void launch_ends() { __tsan_acquire(&launch_place[1]); }
// What is done between these is the machine's own.
SIMT_MACHINE void machine_begins() { __tsan_ignore_thread_begin(); }
SIMT_MACHINE void machine_ends() { __tsan_ignore_thread_end(); }
SIMT_MACHINE void block_begins(char* shared, char* shared_end) {
    ++block_number;
    forget(&places, sizeof places);
    forget(shared, static_cast<size_t>(shared_end - shared));
}
SIMT_MACHINE void thread_begins() { __tsan_acquire(&launch_place[0]); }
SIMT_MACHINE void thread_ends() { __tsan_release(&launch_place[1]); }

}  // namespace simt::races

#endif
