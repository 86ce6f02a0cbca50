// Tensors of memory that comes back (pool.h).
#include <nanobind/ndarray.h>

#include "array_scans.h"
#include "bindings.h"
#include "huge_pages.h"
#include "pool.h"

namespace etsplat {
namespace {

constexpr int64_t kSmallest = 1 << 16;  // numbers; fewer the allocator of the C library recycles by itself

PyObject* from_dlpack = nullptr;  // of torch

template <class T>
struct NewTensor {
    T* data;
    int64_t count = 1;
    nb::object tensor;

    // Uninitialised, contiguous.
    explicit NewTensor(const std::vector<int64_t>& shape) {
        static_assert(sizeof(T) == sizeof(float));
        std::vector<size_t> sizes;
        for (const int64_t size : shape) {
            sizes.push_back(static_cast<size_t>(size));
            count *= size;
        }
        const auto numbers = static_cast<size_t>(count);
        void* block;
        nb::capsule owner;
        if (count < kSmallest) {
            block = acquire_block(numbers * sizeof(T));
            owner = nb::capsule(block, [](void* p) noexcept { release_block(p, 0); });
        } else {
            block = pool_acquire(numbers);
            owner = nb::capsule(block, [](void* p) noexcept { pool_release(static_cast<float*>(p)); });
        }
        data = static_cast<T*>(block);
        const nb::object capsule = nb::cast(nb::ndarray<T>(data, sizes.size(), sizes.data(), owner));
        tensor = nb::handle(from_dlpack)(capsule);
    }
};

}  // namespace

void bind_pool(nb::module_& m) {
    from_dlpack = nb::object(nb::module_::import_("torch").attr("from_dlpack")).release().ptr();
    m.def("pool_idle_bytes", &pool_idle_bytes);
    m.def(
        "empty_floats", [](const std::vector<int64_t>& shape) { return NewTensor<float>(shape).tensor; }, nb::kw_only(),
        nb::arg("shape"), nb::sig("def empty_floats(*, shape: collections.abc.Sequence[int]) -> torch.Tensor"));
    m.def(
        "zero_floats",
        [](const std::vector<int64_t>& shape) {
            const NewTensor<float> zeros(shape);
            {
                const nb::gil_scoped_release release;
                zero_floats(zeros.data, zeros.count);
            }
            return zeros.tensor;
        },
        nb::kw_only(), nb::arg("shape"), nb::sig("def zero_floats(*, shape: collections.abc.Sequence[int]) -> torch.Tensor"));
    // As int32, which holds them.
    m.def(
        "copied_indices",
        [](EitherArray<const int32_t, const int64_t, 2> values) {
            values.check("values");
            const NewTensor<int32_t> copies({values.size(0), values.size(1)});
            {
                const nb::gil_scoped_release release;
                if (values.is<const int64_t>())
                    copy_indices(values.data<const int64_t>(), values.count(), copies.data);
                else
                    copy_indices(values.data<const int32_t>(), values.count(), copies.data);
            }
            return copies.tensor;
        },
        nb::kw_only(), nb::arg("values"), nb::sig("def copied_indices(*, values: torch.Tensor) -> torch.Tensor"));
}

}  // namespace etsplat
