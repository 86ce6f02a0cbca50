#include <nanobind/stl/shared_ptr.h>

#include "antialias.h"
#include "bindings.h"

namespace etsplat {
namespace {

// Views of a mesh with what `rasterize_opaque` found in them, and its colours.
struct ShadedViews : ArgumentGroup {
    Array<const float, 2> vertices;       // (V, 3)
    Array<const int32_t, 2> faces;        // (F, 3)
    Array<const float, 3> viewmats;       // (B, 4, 4)
    Array<const float, 3> Ks;             // (B, 3, 3)
    Array<const int32_t, 3> triangle;     // (B, H, W)
    Array<const float, 4> barycentrics;   // (B, H, W, 3)
    Array<const float> colors;            // (F, C), (V, C), (F, 3, C) or (B, H, W, C)
    ColorsOf colors_of;
    OptionalArray<const float, 2> backgrounds;  // (B, C); None: 0

    OpaqueMesh mesh() const { return {vertices.data(), faces.data(), vertices.size(0), faces.size(0)}; }
    OpaqueCamera camera(int64_t b, float near_plane) const {
        return {viewmats.row(b), Ks.row(b), near_plane, static_cast<int32_t>(triangle.size(2)),
                static_cast<int32_t>(triangle.size(1))};
    }
    ShadeInput view(int64_t b, float near_plane = 0.0f) const {
        return {mesh(), camera(b, near_plane), triangle.row(b), barycentrics.row(b),
                colors_of == ColorsOf::kPixels ? colors.row(b) : colors.data(), colors_of,
                static_cast<int32_t>(colors.size(-1)), row_or_null(backgrounds, b)};
    }
    // What is added to, of view b: by vertices, and colours and backgrounds as above.
    ShadeGradients gradients(int64_t b, const OptionalArray<float, 2>& of_vertices, const OptionalArray<float>& of_colors,
                             const OptionalArray<float, 2>& of_backgrounds) const {
        return {data_or_null(of_vertices),
                colors_of == ColorsOf::kPixels ? row_or_null(of_colors, b) : data_or_null(of_colors),
                row_or_null(of_backgrounds, b)};
    }
};

// Where their silhouettes are looked for; pair_offsets and paired_faces are those of MeshConnectivity.
struct Silhouettes : ArgumentGroup {
    float near_plane;
    Array<const int32_t, 1> pair_offsets, paired_faces;
    Array<const float> depth;  // (B, H, W)

    AntialiasInput view(const ShadedViews& views, int64_t b) const {
        return {views.view(b, near_plane), pair_offsets.data(), paired_faces.data(), depth.row(b)};
    }
};

}  // namespace

void bind_antialias(nb::module_& m) {
    nb::class_<AntialiasState>(m, "AntialiasState");
    nb::enum_<ColorsOf>(m, "ColorsOf", nb::is_arithmetic())
        .value("FACES", ColorsOf::kFaces)
        .value("VERTICES", ColorsOf::kVertices)
        .value("CORNERS", ColorsOf::kCorners)
        .value("PIXELS", ColorsOf::kPixels);
#define MEMBER(name) std::pair(#name, &ShadedViews::name)
    def_group(m, "ShadedViews", MEMBER(vertices), MEMBER(faces), MEMBER(viewmats), MEMBER(Ks), MEMBER(triangle),
              MEMBER(barycentrics), MEMBER(colors), MEMBER(colors_of), MEMBER(backgrounds));
#undef MEMBER
#define MEMBER(name) std::pair(#name, &Silhouettes::name)
    def_group(m, "Silhouettes", MEMBER(near_plane), MEMBER(pair_offsets), MEMBER(paired_faces), MEMBER(depth));
#undef MEMBER
    // shaded (B, H, W, C) is written.
    def_function(
        m, "shade",
        [](const ShadedViews& views, Array<float, 4> shaded) {
            for (int64_t b = 0; b < shaded.size(0); ++b) shade(views.view(b), shaded.row(b));
        },
        "views", "shaded");
    // grad_shaded (B, H, W, C); then what is added to: by vertices (V, 3), and colours.
    def_function(
        m, "shade_backward",
        [](const ShadedViews& views, Array<const float, 4> grad_shaded, OptionalArray<float, 2> grad_vertices,
           OptionalArray<float> grad_colors) {
            for (int64_t b = 0; b < grad_shaded.size(0); ++b) {
                shade_backward(views.view(b), grad_shaded.row(b), views.gradients(b, grad_vertices, grad_colors, {}));
            }
        },
        "views", "grad_shaded", "grad_vertices", "grad_colors");
    // The views' colours are texture coordinates of corners (F, 3, 2); depth and lod are (B, H, W).
    def_function(
        m, "texture_detail",
        [](const ShadedViews& views, Array<const float, 3> depth, int width, int height, Array<float, 3> lod) {
            for (int64_t b = 0; b < lod.size(0); ++b) {
                texture_detail(views.mesh(), views.camera(b, 0.0f), views.triangle.row(b), views.barycentrics.row(b),
                               depth.row(b), views.colors.data(), width, height, lod.row(b));
            }
        },
        "views", "depth", "width", "height", "lod");
    // shaded and color (B, H, W, C) are written. The states of the views refer to no memory but their own.
    def_function(
        m, "antialias_forward",
        [](const ShadedViews& views, const Silhouettes& silhouettes, Array<float, 4> shaded, Array<float, 4> color) {
            std::vector<std::shared_ptr<AntialiasState>> states;
            for (int64_t b = 0; b < color.size(0); ++b) {
                states.push_back(antialias_forward(silhouettes.view(views, b), shaded.row(b), color.row(b)));
            }
            return states;
        },
        "views", "silhouettes", "shaded", "color");
    // The same of two views, of what `rasterize_behind` found: the picture, and what it shows without parts of the mesh.
    def_function(
        m, "antialias_behind",
        [](const ShadedViews& views, const Silhouettes& silhouettes, Array<float, 4> shaded, Array<float, 4> color) {
            const AntialiasInput nearest = silhouettes.view(views, 0), behind = silhouettes.view(views, 1);
            antialias_forward(nearest, shaded.row(0), color.row(0));
            antialias_behind(nearest, behind, shaded.row(0), shaded.row(1), color.row(1));
        },
        "views", "silhouettes", "shaded", "color");
    // grad_color (B, H, W, C); shaded as above; scratch (H, W, C); then what is added to: by vertices (V, 3), colours,
    // backgrounds (B, C).
    def_function(
        m, "antialias_backward",
        [](const std::vector<std::shared_ptr<AntialiasState>>& states, const ShadedViews& views,
           const Silhouettes& silhouettes, Array<const float, 4> grad_color, Array<const float, 4> shaded,
           Array<float, 3> scratch, OptionalArray<float, 2> grad_vertices, OptionalArray<float> grad_colors,
           OptionalArray<float, 2> grad_backgrounds) {
            for (int64_t b = 0; b < grad_color.size(0); ++b) {
                antialias_backward(*states.at(static_cast<size_t>(b)), silhouettes.view(views, b),
                                   {grad_color.row(b), shaded.row(b), scratch.data(),
                                    views.gradients(b, grad_vertices, grad_colors, grad_backgrounds)});
            }
        },
        "states", "views", "silhouettes", "grad_color", "shaded", "scratch", "grad_vertices", "grad_colors",
        "grad_backgrounds");
}

}  // namespace etsplat
