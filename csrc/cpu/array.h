// Torch tensors as arguments of native calls. Of torch nothing is used but attributes of the Python object, so that the
// extension does not depend on its ABI.
//
// An argument of type Array<const float, 4> takes a contiguous float32 tensor with four axes on the CPU; Array<float> one
// that is written, with any number of axes. std::optional<Array<...>> takes None as well. What does not fit is refused by
// the functions of bindings.h, with the name of the argument.
#pragma once

#include <nanobind/nanobind.h>

#include <cstddef>
#include <cstdint>
#include <initializer_list>
#include <type_traits>

namespace etsplat {

constexpr int kAnyRank = -1;
constexpr int kMostAxes = 4;

enum class Dtype : int { kFloat, kDouble, kInt32, kInt64, kByte, kBool };
constexpr int kDtypes = 6;

template <class T>
constexpr Dtype dtype_of() {
    using Value = std::remove_const_t<T>;
    if constexpr (std::is_same_v<Value, float>) return Dtype::kFloat;
    if constexpr (std::is_same_v<Value, double>) return Dtype::kDouble;
    if constexpr (std::is_same_v<Value, int32_t>) return Dtype::kInt32;
    if constexpr (std::is_same_v<Value, int64_t>) return Dtype::kInt64;
    if constexpr (std::is_same_v<Value, uint8_t>) return Dtype::kByte;
    if constexpr (std::is_same_v<Value, bool>) return Dtype::kBool;
}

// Looks up the names and dtypes that reading tensors takes; once, when the module is imported.
void load_torch();

// Where a tensor's values lie, and how many. It refers to the tensor without keeping it alive: for one call.
class ArrayBase {
public:
    int rank() const { return rank_; }
    // Of one of the first kMostAxes axes; counted from the last one if `axis` is negative.
    int64_t size(int axis) const { return sizes_[axis < 0 ? axis + rank_ : axis]; }
    // Of all values, and of those of a row of the first axis.
    int64_t count() const { return count_; }
    int64_t row_count() const { return row_count_; }
    PyObject* tensor() const { return tensor_; }

protected:
    void read(PyObject* tensor) noexcept;
    // Raises TypeError: `name` must be what `wanted` says.
    [[noreturn]] void refuse(const char* name, std::initializer_list<Dtype> wanted, int rank) const;

    PyObject* tensor_ = nullptr;
    void* data_ = nullptr;
    int64_t sizes_[kMostAxes] = {};
    int64_t count_ = 1, row_count_ = 1;
    int rank_ = 0;
    int dtype_ = -1;  // a Dtype; -1: this is no tensor that native code can read
};

template <class T, int Rank = kAnyRank>
class Array : public ArrayBase {
public:
    T* data() const { return static_cast<T*>(data_); }
    // Row `index` of the first axis.
    T* row(int64_t index) const { return data() + index * row_count_; }

    void read(PyObject* tensor) noexcept { ArrayBase::read(tensor); }
    void check(const char* name) const {
        if (dtype_ != static_cast<int>(dtype_of<T>()) || (Rank != kAnyRank && rank_ != Rank)) {
            refuse(name, {dtype_of<T>()}, Rank);
        }
    }
};

// Of one of two types.
template <class First, class Second, int Rank = kAnyRank>
class EitherArray : public ArrayBase {
public:
    template <class T>
    bool is() const {
        return dtype_ == static_cast<int>(dtype_of<T>());
    }
    const void* data() const { return data_; }
    template <class T>
    T* data() const {
        return static_cast<T*>(data_);
    }

    void read(PyObject* tensor) noexcept { ArrayBase::read(tensor); }
    void check(const char* name) const {
        if (!(is<First>() || is<Second>()) || (Rank != kAnyRank && rank_ != Rank)) {
            refuse(name, {dtype_of<First>(), dtype_of<Second>()}, Rank);
        }
    }
};

}  // namespace etsplat

namespace nanobind::detail {

// Takes any object: what is wrong with it is said where its name is known.
template <class A>
struct type_caster<A, enable_if_t<std::is_base_of_v<etsplat::ArrayBase, A>>> {
    NB_TYPE_CASTER(A, const_name("torch.Tensor"))

    bool from_python(handle source, uint32_t, cleanup_list*) noexcept {
        value.read(source.ptr());
        return true;
    }
};

}  // namespace nanobind::detail
