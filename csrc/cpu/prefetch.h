#pragma once

#include "math/portable.h"

namespace etsplat {

// Asks for the cache line of an address that will soon be read, where the compiler has a way to. Without the empty statement
// GCC 12 takes a function that does nothing else for one without effect, and drops its calls.
ETSPLAT_FN void prefetch(const void* p) {
#if defined(_MSC_VER) && !defined(__clang__)
    (void)p;
#else
    __builtin_prefetch(p);
    asm volatile("");
#endif
}

// All of a record's cache lines.
template <class T>
ETSPLAT_FN void prefetch_all(const T& record) {
    const char* bytes = reinterpret_cast<const char*>(&record);
    for (unsigned place = 0; place < sizeof(T); place += 64) prefetch(bytes + place);
}

}  // namespace etsplat
