#include <nanobind/stl/shared_ptr.h>

#include "antialias.h"
#include "bindings.h"

namespace etsplat {

void bind_antialias(nb::module_& m) {
    nb::class_<AntialiasState>(m, "AntialiasState")
        .def_prop_ro("num_blends", [](const AntialiasState& state) { return state.blends.size(); });
    nb::class_<AntialiasInput>(m, "AntialiasInput")
        // Addresses of one view, all float32 and int32: vertices (V, 3); faces (F, 3); viewmat (4, 4); K (3, 3);
        // pair_offsets, paired_faces of MeshConnectivity; triangle (H, W), barycentrics (H, W, 3), depth (H, W) of
        // rasterize_hard; face_colors (F, C) or 0, then vertex_colors (V, C); background (C,).
        .def("__init__",
             [](AntialiasInput* input, Address vertices, Address faces, int64_t num_vertices, int64_t num_faces,
                Address viewmat, Address K, float near_plane, int32_t width, int32_t height, Address pair_offsets,
                Address paired_faces, Address triangle, Address barycentrics, Address depth, Address face_colors,
                Address vertex_colors, int32_t channels, Address background) {
                 new (input) AntialiasInput{
                     {pointer<const float>(vertices), pointer<const int32_t>(faces), num_vertices, num_faces},
                     {pointer<const float>(viewmat), pointer<const float>(K), near_plane, width, height},
                     pointer<const int32_t>(pair_offsets),
                     pointer<const int32_t>(paired_faces),
                     pointer<const int32_t>(triangle),
                     pointer<const float>(barycentrics),
                     pointer<const float>(depth),
                     {pointer<const float>(face_colors), pointer<const float>(vertex_colors), channels},
                     pointer<const float>(background)};
             });
    // shaded and color (H, W, C) are written. The state refers to no memory but its own.
    m.def(
        "antialias_forward",
        [](const AntialiasInput& input, Address shaded, Address color) {
            return antialias_forward(input, pointer<float>(shaded), pointer<float>(color));
        },
        NoGil());
    // grad_color (H, W, C); shaded as above; grad_shaded (H, W, C) scratch; then what is added to, or 0: vertices (V, 3),
    // colours (F or V, C), background (C,).
    m.def(
        "antialias_backward",
        [](const AntialiasState& state, const AntialiasInput& input, Address grad_color, Address shaded,
           Address grad_shaded, Address vertices, Address colors, Address background) {
            antialias_backward(state, input,
                               {pointer<const float>(grad_color), pointer<const float>(shaded),
                                pointer<float>(grad_shaded), pointer<float>(vertices), pointer<float>(colors),
                                pointer<float>(background)});
        },
        NoGil());
}

}  // namespace etsplat
