#include <nanobind/stl/shared_ptr.h>

#include "antialias.h"
#include "bindings.h"

namespace etsplat {
namespace {

// Views of a mesh with what `rasterize_opaque` found in them; pair_offsets and paired_faces are those of MeshConnectivity.
struct AntialiasViews : ArgumentGroup {
    Array<const float, 2> vertices;    // (V, 3)
    Array<const int32_t, 2> faces;     // (F, 3)
    Array<const float, 3> viewmats;    // (B, 4, 4)
    Array<const float, 3> Ks;          // (B, 3, 3)
    float near_plane;
    Array<const int32_t, 1> pair_offsets, paired_faces;
    Array<const int32_t, 3> triangle;    // (B, H, W)
    Array<const float, 4> barycentrics;  // (B, H, W, 3)
    Array<const float> depth;            // (B, H, W, 1)
    Array<const float, 2> colors;        // (F, C) or (V, C)
    bool per_face;
    Array<const float, 2> backgrounds;   // (B, C)

    AntialiasInput view(int64_t b) const {
        return {{vertices.data(), faces.data(), vertices.size(0), faces.size(0)},
                {viewmats.row(b), Ks.row(b), near_plane, static_cast<int32_t>(triangle.size(2)),
                 static_cast<int32_t>(triangle.size(1))},
                pair_offsets.data(),
                paired_faces.data(),
                triangle.row(b),
                barycentrics.row(b),
                depth.row(b),
                {per_face ? colors.data() : nullptr, per_face ? nullptr : colors.data(),
                 static_cast<int32_t>(colors.size(1))},
                backgrounds.row(b)};
    }
};

}  // namespace

void bind_antialias(nb::module_& m) {
    nb::class_<AntialiasState>(m, "AntialiasState");
#define MEMBER(name) std::pair(#name, &AntialiasViews::name)
    def_group(m, "AntialiasViews", MEMBER(vertices), MEMBER(faces), MEMBER(viewmats), MEMBER(Ks), MEMBER(near_plane),
              MEMBER(pair_offsets), MEMBER(paired_faces), MEMBER(triangle), MEMBER(barycentrics), MEMBER(depth),
              MEMBER(colors), MEMBER(per_face), MEMBER(backgrounds));
#undef MEMBER
    // shaded and color (B, H, W, C) are written. The states of the views refer to no memory but their own.
    def_function(
        m, "antialias_forward",
        [](const AntialiasViews& views, Array<float, 4> shaded, Array<float, 4> color) {
            std::vector<std::shared_ptr<AntialiasState>> states;
            for (int64_t b = 0; b < color.size(0); ++b) {
                states.push_back(antialias_forward(views.view(b), shaded.row(b), color.row(b)));
            }
            return states;
        },
        "views", "shaded", "color");
    // grad_color (B, H, W, C); shaded as above; scratch (H, W, C); then what is added to: by vertices (V, 3), colours (F or
    // V, C), backgrounds (B, C).
    def_function(
        m, "antialias_backward",
        [](const std::vector<std::shared_ptr<AntialiasState>>& states, const AntialiasViews& views,
           Array<const float, 4> grad_color, Array<const float, 4> shaded, Array<float, 3> scratch,
           OptionalArray<float, 2> grad_vertices, OptionalArray<float, 2> grad_colors,
           OptionalArray<float, 2> grad_backgrounds) {
            for (int64_t b = 0; b < grad_color.size(0); ++b) {
                antialias_backward(*states.at(static_cast<size_t>(b)), views.view(b),
                                   {grad_color.row(b), shaded.row(b), scratch.data(), data_or_null(grad_vertices),
                                    data_or_null(grad_colors), row_or_null(grad_backgrounds, b)});
            }
        },
        "states", "views", "grad_color", "shaded", "scratch", "grad_vertices", "grad_colors", "grad_backgrounds");
}

}  // namespace etsplat
