// Each file csrc/cpu/bind_*.cpp exposes one family of operations; module.cpp calls them all.
//
// Tensors cross as raw addresses (Tensor.data_ptr()) with their sizes, so that the extension depends on neither
// torch's nor numpy's ABI. The Python caller in etsplat/ops or etsplat/geometry guarantees: contiguous, on the CPU, of
// the documented type. Every function releases the GIL.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <cstdint>

namespace etsplat {

namespace nb = nanobind;
using Address = std::uintptr_t;

template <class T>
T* pointer(Address address) {
    return reinterpret_cast<T*>(address);
}

using NoGil = nb::call_guard<nb::gil_scoped_release>;

}  // namespace etsplat
