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
    // Of R parts of the photos: sums (R, F, 2, 15), gains (F,).
    def_function(
        m, "halving_gains",
        [](Array<const float, 4> sums, Array<double, 1> gains) {
            halving_gains(sums.data(), sums.size(0), sums.size(1), gains.data());
        },
        "sums", "gains");
}

}  // namespace etsplat
