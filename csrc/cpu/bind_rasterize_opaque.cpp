#include "bindings.h"
#include "rasterize_opaque.h"

namespace etsplat {
namespace {

OpaqueMesh mesh_of(const Array<const float, 2>& vertices, const Array<const int32_t, 2>& faces) {
    return {vertices.data(), faces.data(), vertices.size(0), faces.size(0)};
}

OpaqueCamera camera_of(const Array<const float, 2>& viewmat, const Array<const float, 2>& K, float near_plane, int64_t height,
                       int64_t width) {
    return {viewmat.data(), K.data(), near_plane, static_cast<int32_t>(width), static_cast<int32_t>(height)};
}

}  // namespace

void bind_rasterize_opaque(nb::module_& m) {
    // Of one view: vertices (V, 3), faces (F, 3), viewmat (4, 4), K (3, 3); triangle (H, W), barycentrics (H, W, 3) or None,
    // depth (H, W).
    def_function(
        m, "rasterize_opaque",
        [](Array<const float, 2> vertices, Array<const int32_t, 2> faces, Array<const float, 2> viewmat,
           Array<const float, 2> K, float near_plane, Array<int32_t, 2> triangle, OptionalArray<float, 3> barycentrics,
           Array<float, 2> depth) {
            const OpaqueMesh mesh = mesh_of(vertices, faces);
            const OpaqueCamera camera = camera_of(viewmat, K, near_plane, triangle.size(0), triangle.size(1));
            rasterize_opaque(mesh, camera, {triangle.data(), data_or_null(barycentrics), depth.data()});
        },
        "vertices", "faces", "viewmat", "K", "near_plane", "triangle", "barycentrics", "depth");
    // As above, of the nearest triangles and of those behind: triangle (2, H, W), barycentrics (2, H, W, 3), depth (2, H, W).
    def_function(
        m, "rasterize_behind",
        [](Array<const float, 2> vertices, Array<const int32_t, 2> faces, Array<const float, 2> viewmat,
           Array<const float, 2> K, float near_plane, Array<int32_t, 3> triangle, Array<float, 4> barycentrics,
           Array<float, 3> depth) {
            const OpaqueMesh mesh = mesh_of(vertices, faces);
            const OpaqueCamera camera = camera_of(viewmat, K, near_plane, triangle.size(1), triangle.size(2));
            rasterize_behind(mesh, camera, {triangle.row(0), barycentrics.row(0), depth.row(0)},
                             {triangle.row(1), barycentrics.row(1), depth.row(1)});
        },
        "vertices", "faces", "viewmat", "K", "near_plane", "triangle", "barycentrics", "depth");
    // As above; turned (F,), entered and left (H, W).
    def_function(
        m, "enter_and_leave",
        [](Array<const float, 2> vertices, Array<const int32_t, 2> faces, Array<const float, 2> viewmat,
           Array<const float, 2> K, float near_plane, Array<const bool, 1> turned, Array<int64_t, 2> entered,
           Array<int64_t, 2> left) {
            const OpaqueMesh mesh = mesh_of(vertices, faces);
            const OpaqueCamera camera = camera_of(viewmat, K, near_plane, entered.size(0), entered.size(1));
            enter_and_leave(mesh, camera, turned.data(), entered.data(), left.data());
        },
        "vertices", "faces", "viewmat", "K", "near_plane", "turned", "entered", "left");
    // As above; colors (F, C) or (V, C), image (H, W, C + 1).
    def_function(
        m, "render_opaque",
        [](Array<const float, 2> vertices, Array<const int32_t, 2> faces, Array<const float, 2> viewmat,
           Array<const float, 2> K, float near_plane, Array<const float, 2> colors, bool per_face,
           int32_t supersampling, bool cull_backfaces, Array<float, 3> image) {
            const OpaqueMesh mesh = mesh_of(vertices, faces);
            const OpaqueCamera camera = camera_of(viewmat, K, near_plane, image.size(0), image.size(1));
            const OpaqueColors shown{per_face ? colors.data() : nullptr, per_face ? nullptr : colors.data(),
                                   static_cast<int32_t>(colors.size(1))};
            render_opaque(mesh, camera, shown, supersampling, cull_backfaces, image.data());
        },
        "vertices", "faces", "viewmat", "K", "near_plane", "colors", "per_face", "supersampling", "cull_backfaces",
        "image");
}

}  // namespace etsplat
