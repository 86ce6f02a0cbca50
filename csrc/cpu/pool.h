// Memory for images that comes back when the last tensor that uses it dies.
//
// A large tensor made by malloc is new to the process: its first write costs a page fault every 4 KiB, together more
// than some kernels. A step of training asks for nearly the same sizes again and again, so their blocks are kept, and
// those that nobody has asked for lately are not.
#pragma once

#include <cstddef>

namespace etsplat {

float* pool_acquire(std::size_t count);  // uninitialised
void pool_release(float* block) noexcept;
std::size_t pool_idle_bytes();

}  // namespace etsplat
