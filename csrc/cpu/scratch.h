// Room for what a call needs until it ends, uninitialised, from the pool (pool.h): a step that follows finds it warm.
#pragma once

#include <cstddef>
#include <cstdint>
#include <utility>

#include "pool.h"

namespace etsplat {

template <class T>
class Scratch {
public:
    explicit Scratch(int64_t n)
        : size_(n), data_(reinterpret_cast<T*>(pool_acquire((static_cast<size_t>(n) * sizeof(T) + 3) / sizeof(float)))) {}
    Scratch(Scratch&& other) noexcept : size_(other.size_), data_(std::exchange(other.data_, nullptr)) {}
    Scratch& operator=(Scratch&&) = delete;
    ~Scratch() {
        if (data_) pool_release(reinterpret_cast<float*>(data_));
    }

    T* data() { return data_; }
    T& operator[](int64_t i) { return data_[i]; }
    const T& operator[](int64_t i) const { return data_[i]; }
    int64_t size() const { return size_; }
    T* begin() { return data_; }
    T* end() { return data_ + size_; }
    const T* begin() const { return data_; }
    const T* end() const { return data_ + size_; }

private:
    int64_t size_;
    T* data_;
};

}  // namespace etsplat
