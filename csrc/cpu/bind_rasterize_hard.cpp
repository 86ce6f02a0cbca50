#include "bindings.h"
#include "rasterize_hard.h"

namespace etsplat {

void bind_rasterize_hard(nb::module_& m) {
    // Addresses: vertices (V, 3) float32; faces (F, 3) int32; viewmat (4, 4), K (3, 3) float32 of one view;
    // triangle (H, W) int32; barycentrics (H, W, 3), depth (H, W) float32.
    m.def(
        "rasterize_hard",
        [](Address vertices, Address faces, int64_t num_vertices, int64_t num_faces, Address viewmat, Address K,
           float near_plane, int32_t width, int32_t height, Address triangle, Address barycentrics, Address depth) {
            const HardMesh mesh{pointer<const float>(vertices), pointer<const int32_t>(faces), num_vertices, num_faces};
            const HardCamera camera{pointer<const float>(viewmat), pointer<const float>(K), near_plane, width, height};
            rasterize_hard(mesh, camera, pointer<int32_t>(triangle), pointer<float>(barycentrics),
                           pointer<float>(depth));
        },
        NoGil());
    // As above; face_colors (F, C) or 0, then vertex_colors (V, C); image (H, W, C + 1) float32.
    m.def(
        "render_opaque",
        [](Address vertices, Address faces, int64_t num_vertices, int64_t num_faces, Address viewmat, Address K,
           float near_plane, int32_t width, int32_t height, Address face_colors, Address vertex_colors,
           int32_t channels, int32_t supersampling, bool cull_backfaces, Address image) {
            const HardMesh mesh{pointer<const float>(vertices), pointer<const int32_t>(faces), num_vertices, num_faces};
            const HardCamera camera{pointer<const float>(viewmat), pointer<const float>(K), near_plane, width, height};
            const HardColors colors{pointer<const float>(face_colors), pointer<const float>(vertex_colors), channels};
            render_opaque(mesh, camera, colors, supersampling, cull_backfaces, pointer<float>(image));
        },
        NoGil());
}

}  // namespace etsplat
