#include "array.h"

#include <nanobind/stl/string.h>

#include <string>

namespace nb = nanobind;

namespace etsplat {
namespace {

struct TorchNames {
    PyObject *dtype, *is_cpu, *is_contiguous, *shape, *data_ptr;
    PyObject* dtypes[kDtypes];
} torch;

constexpr const char* kDtypeNames[kDtypes] = {"float32", "float64", "int32", "int64", "uint8", "bool"};

nb::object attribute(PyObject* object, PyObject* name) { return nb::steal(PyObject_GetAttr(object, name)); }
nb::object call_method(PyObject* object, PyObject* name) {
    return nb::steal(PyObject_CallMethodObjArgs(object, name, nullptr));
}

std::string written(const nb::object& object) {
    return nb::cast<std::string>(nb::steal<nb::str>(PyObject_Str(object.ptr())));
}

// The number of axes, or -1.
int read_sizes(PyObject* shape, int64_t* sizes) {
    const Py_ssize_t rank = PyTuple_Size(shape);
    if (rank < 0 || rank > kMostAxes) return -1;
    for (Py_ssize_t axis = 0; axis < rank; ++axis) {
        sizes[axis] = PyLong_AsLongLong(PyTuple_GetItem(shape, axis));
        if (sizes[axis] < 0) return -1;
    }
    return static_cast<int>(rank);
}

}  // namespace

void load_torch() {
    // Of the interpreter, and for as long as it runs.
    torch = {PyUnicode_InternFromString("dtype"), PyUnicode_InternFromString("is_cpu"),
             PyUnicode_InternFromString("is_contiguous"), PyUnicode_InternFromString("shape"),
             PyUnicode_InternFromString("data_ptr"), {}};
    const nb::module_ module = nb::module_::import_("torch");
    for (int i = 0; i < kDtypes; ++i) torch.dtypes[i] = nb::object(module.attr(kDtypeNames[i])).release().ptr();
}

void ArrayBase::read(PyObject* tensor) noexcept {
    tensor_ = tensor;
    const nb::object dtype = attribute(tensor, torch.dtype);
    for (int i = 0; i < kDtypes; ++i) {
        if (dtype.ptr() == torch.dtypes[i]) dtype_ = i;
    }
    if (dtype_ < 0 || attribute(tensor, torch.is_cpu).ptr() != Py_True ||
        call_method(tensor, torch.is_contiguous).ptr() != Py_True) {
        dtype_ = -1;
    } else {
        rank_ = read_sizes(attribute(tensor, torch.shape).ptr(), sizes_);
        const nb::object address = call_method(tensor, torch.data_ptr);
        data_ = address.is_valid() ? PyLong_AsVoidPtr(address.ptr()) : nullptr;
        if (rank_ < 0 || !address.is_valid()) dtype_ = -1;
    }
    PyErr_Clear();
}

void ArrayBase::refuse(const char* name, std::initializer_list<Dtype> wanted, int rank) const {
    std::string text = std::string(name) + " must be a contiguous ";
    for (const Dtype dtype : wanted) {
        if (dtype != *wanted.begin()) text += " or ";
        text += kDtypeNames[static_cast<int>(dtype)];
    }
    text += " tensor on the CPU";
    if (rank != kAnyRank) text += " with " + std::to_string(rank) + " axes";
    const nb::handle given(tensor_);
    if (nb::hasattr(given, "is_contiguous")) {
        text += ", got " + written(given.attr("dtype")) + " of shape " + written(nb::tuple(given.attr("shape"))) + " on " +
                written(given.attr("device")) + (given.attr("is_contiguous")().is(nb::bool_(true)) ? "" : ", not contiguous");
    } else {
        text += ", got " + written(nb::borrow(given.type()));
    }
    throw nb::type_error(text.c_str());
}

}  // namespace etsplat
