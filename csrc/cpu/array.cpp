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
    *this = ArrayBase();  // casters of lists read one tensor after the other
    tensor_ = tensor;
    const nb::object dtype = attribute(tensor, torch.dtype);
    for (int i = 0; i < kDtypes; ++i) {
        if (dtype.ptr() == torch.dtypes[i]) dtype_ = i;
    }
    const bool dense = dtype_ >= 0 && attribute(tensor, torch.is_cpu).ptr() == Py_True &&
                       call_method(tensor, torch.is_contiguous).ptr() == Py_True;
    const nb::object shape = dense ? attribute(tensor, torch.shape) : nb::object();
    const nb::object address = shape.is_valid() ? call_method(tensor, torch.data_ptr) : nb::object();
    if (address.is_valid()) {
        rank_ = static_cast<int>(PyTuple_Size(shape.ptr()));
        for (int axis = 0; axis < rank_; ++axis) {
            const int64_t size = PyLong_AsLongLong(PyTuple_GetItem(shape.ptr(), axis));
            if (axis < kMostAxes) sizes_[axis] = size;
            if (axis > 0) row_count_ *= size;
            count_ *= size;
        }
        data_ = PyLong_AsVoidPtr(address.ptr());
    }
    if (!address.is_valid() || PyErr_Occurred()) dtype_ = -1;
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
