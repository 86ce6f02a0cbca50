// Each file csrc/cpu/bind_*.cpp exposes one family of operations; module.cpp calls them all. What they expose is described
// by its C++ types and the names beside them, and nowhere else: src/etsplat/_native.pyi is made of it (make stubs).
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <cstdint>
#include <optional>
#include <type_traits>
#include <utility>
#include <vector>

#include "array.h"

namespace etsplat {

namespace nb = nanobind;
template <class T, int Rank = kAnyRank>
using OptionalArray = std::optional<Array<T, Rank>>;

template <class T, int Rank>
T* data_or_null(const OptionalArray<T, Rank>& array) {
    return array ? array->data() : nullptr;
}

template <class T, int Rank>
T* row_or_null(const OptionalArray<T, Rank>& array, int64_t index) {
    return array ? array->row(index) : nullptr;
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

template <class T>
void keep(std::vector<nb::object>& kept, const T& value) {
    if constexpr (std::is_base_of_v<ArrayBase, T>) kept.push_back(nb::borrow(value.tensor()));
}
template <class T>
void keep(std::vector<nb::object>& kept, const std::optional<T>& value) {
    if (value) keep(kept, *value);
}

}  // namespace bindings_detail

// Exposes `function`, a lambda, whose arguments are given by name. It runs without the GIL.
template <class Function, class... Names>
void def_function(nb::module_& m, const char* name, const Function& function, const Names&... names) {
    m.def(name, bindings_detail::guarded(function, &Function::operator(), names...), nb::kw_only(), nb::arg(names)...);
}

// Arguments of a call under a name of their own. It keeps the tensors alive.
struct ArgumentGroup {
    std::vector<nb::object> kept;
};

// Exposes a group, whose members are given by name when one is made.
template <class Group, class... Members>
void def_group(nb::module_& m, const char* name, std::pair<const char*, Members Group::*>... members) {
    nb::class_<Group>(m, name).def(
        "__init__",
        [members...](Group* self, Members... values) {
            (bindings_detail::check_argument(members.first, values), ...);
            Group group{};
            ((group.*members.second = values), ...);
            (bindings_detail::keep(group.kept, values), ...);
            new (self) Group(std::move(group));
        },
        nb::kw_only(), nb::arg(members.first)...);
}

}  // namespace etsplat
