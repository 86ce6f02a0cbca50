#include "array_scans.h"
#include "bindings.h"

namespace etsplat {

void bind_array_scans(nb::module_& m) {
    nb::class_<FloatScan>(m, "FloatScan").def_ro("unusable", &FloatScan::unusable).def_ro("minimum", &FloatScan::minimum);
    nb::class_<IndexRange>(m, "IndexRange").def_ro("low", &IndexRange::low).def_ro("high", &IndexRange::high);
    // Addresses of contiguous arrays of `count` float32, int32 or int64; indices must not be empty.
    m.def(
        "scan_floats",
        [](Address values, int64_t count, float largest) {
            return scan_floats(pointer<const float>(values), count, largest);
        },
        NoGil());
    m.def(
        "index_range",
        [](Address values, int64_t count, bool wide) {
            return wide ? index_range(pointer<const int64_t>(values), count)
                        : index_range(pointer<const int32_t>(values), count);
        },
        NoGil());
    // values (count,) int32 from 0 to groups - 1, offsets (groups + 1,), members (count,).
    m.def(
        "group_indices",
        [](Address values, int64_t count, int64_t groups, Address offsets, Address members) {
            group_indices(pointer<const int32_t>(values), count, groups, pointer<int32_t>(offsets),
                          pointer<int32_t>(members));
        },
        NoGil());
    // values (N, C), offsets (groups + 1,), members into the rows of `values`: sums (groups, C), each in the order of its
    // members.
    m.def(
        "sum_groups",
        [](Address values, Address offsets, Address members, int64_t groups, int64_t channels, Address sums) {
            sum_groups(pointer<const float>(values), pointer<const int32_t>(offsets), pointer<const int32_t>(members),
                       groups, channels, pointer<float>(sums));
        },
        NoGil());
    m.def(
        "zero_floats", [](Address values, int64_t count) { zero_floats(pointer<float>(values), count); }, NoGil());
}

}  // namespace etsplat
