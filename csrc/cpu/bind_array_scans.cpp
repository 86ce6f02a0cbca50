#include "array_scans.h"
#include "bindings.h"

namespace etsplat {

void bind_array_scans(nb::module_& m) {
    nb::class_<FloatScan>(m, "FloatScan").def_ro("unusable", &FloatScan::unusable).def_ro("minimum", &FloatScan::minimum);
    nb::class_<IndexRange>(m, "IndexRange").def_ro("low", &IndexRange::low).def_ro("high", &IndexRange::high);
    def_function(
        m, "scan_floats",
        [](Array<const float> values, float largest) { return scan_floats(values.data(), values.count(), largest); },
        "values", "largest");
    // Of at least one index.
    def_function(
        m, "index_range",
        [](EitherArray<const int32_t, const int64_t> values) {
            return values.is<const int64_t>() ? index_range(values.data<const int64_t>(), values.count())
                                              : index_range(values.data<const int32_t>(), values.count());
        },
        "values");
    // values (N,) from 0 to groups - 1, offsets (groups + 1,), members (N,).
    def_function(
        m, "group_indices",
        [](Array<const int32_t, 1> values, Array<int32_t, 1> offsets, Array<int32_t, 1> members) {
            group_indices(values.data(), values.count(), offsets.count() - 1, offsets.data(), members.data());
        },
        "values", "offsets", "members");
    // values (..., C), offsets (groups + 1,), members into the rows of `values`: sums (groups, C), each in the order of its
    // members.
    def_function(
        m, "sum_groups",
        [](Array<const float> values, Array<const int32_t, 1> offsets, Array<const int32_t, 1> members,
           Array<float, 2> sums) {
            sum_groups(values.data(), offsets.data(), members.data(), sums.size(0), sums.size(1), sums.data());
        },
        "values", "offsets", "members", "sums");
    def_function(m, "zero_floats", [](Array<float> values) { zero_floats(values.data(), values.count()); }, "values");
}

}  // namespace etsplat
