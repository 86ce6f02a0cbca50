// Growable, uninitialised, cache-line aligned storage. Its memory is kept when it shrinks, so that a recycled state
// costs no page faults.
#pragma once

#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <utility>

#include "huge_pages.h"
#include "parallel.h"

namespace etsplat {

template <class T>
class Buffer {
public:
    Buffer() = default;
    Buffer(const Buffer&) = delete;
    Buffer& operator=(const Buffer&) = delete;
    ~Buffer() { release(); }

    void resize(int64_t n) {
        if (n > capacity_) {
            release();
            const int64_t wanted = n + n / 8;
            data_ = static_cast<T*>(acquire_block(block_size(wanted)));
            capacity_ = wanted;
        }
        size_ = n;
    }
    void fill_zero() {
        parallel_for(size_, int64_t{1} << 16, [this](int64_t begin, int64_t end) {
            std::memset(static_cast<void*>(data_ + begin), 0, static_cast<size_t>(end - begin) * sizeof(T));
        });
    }
    T* data() { return data_; }
    const T* data() const { return data_; }
    T& operator[](int64_t i) { return data_[i]; }
    const T& operator[](int64_t i) const { return data_[i]; }
    int64_t size() const { return size_; }
    int64_t bytes() const { return capacity_ * static_cast<int64_t>(sizeof(T)); }
    void swap(Buffer& other) {
        std::swap(data_, other.data_);
        std::swap(size_, other.size_);
        std::swap(capacity_, other.capacity_);
    }

private:
    static size_t block_size(int64_t n) { return static_cast<size_t>(n) * sizeof(T) + 64; }
    void release() {
        if (data_) release_block(data_, block_size(capacity_));
        data_ = nullptr;
        capacity_ = 0;
    }

    T* data_ = nullptr;
    int64_t size_ = 0, capacity_ = 0;
};

}  // namespace etsplat
