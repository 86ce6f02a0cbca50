// A child of fork() has one thread, and the locks as they were: also those of threads that it has not.
#pragma once

#include <mutex>

#if !defined(_WIN32)
#include <pthread.h>
#endif

namespace etsplat {

// At namespace scope: `act` is called in every child.
struct AfterFork {
    explicit AfterFork([[maybe_unused]] void (*act)()) {
#if !defined(_WIN32)
        pthread_atfork(nullptr, nullptr, act);
#endif
    }
};

// At namespace scope: nobody is between lock and unlock of the mutex while a process forks, so that children find it
// free and what it guards whole. For mutexes that are held for a moment.
template <std::mutex& mutex>
struct LockedWhileForking {
    LockedWhileForking() {
#if !defined(_WIN32)
        const auto unlock = [] { mutex.unlock(); };
        pthread_atfork([] { mutex.lock(); }, unlock, unlock);
#endif
    }
};

}  // namespace etsplat
