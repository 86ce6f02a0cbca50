#pragma once

#include "math/portable.h"

namespace etsplat {

// Asks for the cache line of an address that will soon be read, where the compiler has a way to.
ETSPLAT_FN void prefetch(const void* p) {
#if defined(_MSC_VER) && !defined(__clang__)
    (void)p;
#else
    __builtin_prefetch(p);
#endif
}

}  // namespace etsplat
