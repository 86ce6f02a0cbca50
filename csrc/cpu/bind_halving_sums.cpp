#include "bindings.h"
#include "halving_sums.h"

namespace etsplat {

void bind_halving_sums(nb::module_& m) {
    // Of P pixels: face (P,), barycentrics (P, 3), lacking (P, 3), counted (P,); longest (F,); sums (F, 2, 15) is added to.
    def_function(
        m, "add_halving_sums",
        [](Array<const int64_t, 1> face, Array<const float, 2> barycentrics, Array<const float, 2> lacking,
           Array<const float, 1> counted, Array<const int64_t, 1> longest, Array<float, 3> sums) {
            const HalvingPixels pixels{face.data(), barycentrics.data(), lacking.data(), counted.data(), face.size(0)};
            add_halving_sums(pixels, longest.data(), sums.data());
        },
        "face", "barycentrics", "lacking", "counted", "longest", "sums");
}

}  // namespace etsplat
