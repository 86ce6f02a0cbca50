// Each file csrc/cpu/bind_*.cpp exposes one family of operations; module.cpp calls them all. What they expose is described
// by its C++ types and the names beside them, and nowhere else: src/etsplat/_native.pyi is made of it (make stubs).
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <cstdint>
#include <optional>

#include "array.h"

namespace etsplat {

namespace nb = nanobind;
using Address = std::uintptr_t;

template <class T>
T* pointer(Address address) {
    return reinterpret_cast<T*>(address);
}

using NoGil = nb::call_guard<nb::gil_scoped_release>;

template <class T, int Rank = kAnyRank>
using OptionalArray = std::optional<Array<T, Rank>>;

template <class T, int Rank>
T* data_or_null(const OptionalArray<T, Rank>& array) {
    return array ? array->data() : nullptr;
}

namespace bindings_detail {

template <class T>
void check_argument(const char* name, const T& value) {
    if constexpr (std::is_base_of_v<ArrayBase, T>) value.check(name);
}
template <class T>
void check_argument(const char* name, const std::optional<T>& value) {
    if (value) check_argument(name, *value);
}
template <class T>
void check_argument(const char* name, const std::vector<T>& values) {
    for (const T& value : values) check_argument(name, value);
}

// The function behind checks of its arguments, without the GIL.
template <class Function, class Return, class... Arguments, class... Names>
auto guarded(const Function& function, Return (Function::*)(Arguments...) const, const Names&... names) {
    return [function, names...](Arguments... arguments) -> Return {
        (check_argument(names, arguments), ...);
        nb::gil_scoped_release release;
        return function(arguments...);
    };
}

}  // namespace bindings_detail

// Exposes `function`, a lambda, whose arguments are given by name. It runs without the GIL.
template <class Function, class... Names>
void def_function(nb::module_& m, const char* name, const Function& function, const Names&... names) {
    m.def(name, bindings_detail::guarded(function, &Function::operator(), names...), nb::kw_only(), nb::arg(names)...);
}

}  // namespace etsplat
