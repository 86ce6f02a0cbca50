#include "array_scans.h"
#include "bindings.h"

namespace etsplat {

void bind_array_scans(nb::module_& m) {
    nb::class_<FloatScan>(m, "FloatScan").def_ro("unusable", &FloatScan::unusable).def_ro("minimum", &FloatScan::minimum);
    def_function(
        m, "scan_floats",
        [](Array<const float> values, float largest) { return scan_floats(values.data(), values.count(), largest); },
        "values", "largest");
    // Whether all are from 0 to bound - 1.
    def_function(
        m, "indices_below",
        [](EitherArray<const int32_t, const int64_t> values, int64_t bound) {
            return values.is<const int64_t>() ? indices_below(values.data<const int64_t>(), values.count(), bound)
                                              : indices_below(values.data<const int32_t>(), values.count(), bound);
        },
        "values", "bound");
    // Whether all of Ks (B, 3, 3) are [[fx, 0, cx], [0, fy, cy], [0, 0, 1]].
    def_function(
        m, "are_intrinsics", [](Array<const float, 3> Ks) { return are_intrinsics(Ks.data(), Ks.size(0)); }, "Ks");
    // values (..., C), an index from 0 to rows - 1 for each of its rows, sums (rows, C).
    def_function(
        m, "sum_by_index",
        [](Array<const float> values, Array<const int32_t> indices, Array<float, 2> sums) {
            sum_by_index(values.data(), indices.data(), indices.count(), sums.size(0), sums.size(1), sums.data());
        },
        "values", "indices", "sums");
    // values (V, C), an index from 0 to V - 1 for each row of rows (..., C).
    def_function(
        m, "gather_rows",
        [](Array<const float, 2> values, Array<const int32_t> indices, Array<float> rows) {
            gather_rows(values.data(), indices.data(), indices.count(), values.size(1), rows.data());
        },
        "values", "indices", "rows");
}

}  // namespace etsplat
