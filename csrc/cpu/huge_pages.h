// Memory for large arrays, aligned to cache lines. Tiles reach into records, entries and slots all over them: with pages of
// 4 KiB nearly each such access misses the processor's table of pages, with pages of 2 MiB none does.
#pragma once

#include <cstddef>
#include <new>

#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace etsplat {

constexpr std::size_t kHugePage = std::size_t{2} << 20;

inline std::align_val_t block_alignment(std::size_t bytes) {
    return std::align_val_t{bytes < 2 * kHugePage ? std::size_t{64} : kHugePage};
}

// To be given back by `release_block` with the same number.
inline void* acquire_block(std::size_t bytes) {
    void* block = ::operator new(bytes, block_alignment(bytes));
#if defined(MADV_HUGEPAGE)
    // Advice; a system without huge pages says no. The rest behind whole ones stays on small ones.
    if (bytes >= 2 * kHugePage) madvise(block, bytes / kHugePage * kHugePage, MADV_HUGEPAGE);
#endif
    return block;
}

inline void release_block(void* block, std::size_t bytes) noexcept { ::operator delete(block, block_alignment(bytes)); }

}  // namespace etsplat
