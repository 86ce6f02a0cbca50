#include <nanobind/stl/shared_ptr.h>

#include "bindings.h"
#include "instruction_set.h"
#include "raster.h"
#include "raster_diagnostics.h"

namespace etsplat {
namespace {

// All views of a batch.
struct RasterBatch : ArgumentGroup {
    Array<const float> vertices;               // (N, 3, 3), or (V, 3) with faces
    OptionalArray<const int32_t, 2> faces;     // (N, 3)
    OptionalArray<const float> flat_colors;    // (N, F) or (B, N, F)
    OptionalArray<const float> corner_colors;  // (N, 3, K) or (B, N, 3, K)
    Array<const float, 1> opacities;           // (N,)
    Array<const float> sigmas;                 // (N,) or one
    Array<const float, 3> viewmats;            // (B, 4, 4)
    Array<const float, 3> Ks;                  // (B, 3, 3)
    OptionalArray<const float, 2> backgrounds;   // (B, F + K)
    OptionalArray<const float, 1> kernel_table;  // of kernel "Tabulated"
    int kernel, distance;
    bool freeze_inradius;
    float near_plane, alpha_min, alpha_max, x_max, transmittance_min, distortion_near, distortion_far;
    bool centroid_depth;
    Array<float, 4> color;                           // (B, H, W, F + K)
    Array<float, 4> alpha;                           // (B, H, W, 1)
    OptionalArray<float, 4> distortion;              // (B, H, W, 1)
    OptionalArray<float, 4> distortion_totals;       // (B, H, W, 2)

    RasterCall view(int64_t b) const {
        RasterCall call;
        call.vertices = vertices.data();
        call.faces = data_or_null(faces);
        call.num_vertices = vertices.size(0);
        call.num_triangles = faces ? faces->size(0) : vertices.size(0);
        call.flat_colors = own_or_shared(flat_colors, 3, b);
        call.corner_colors = own_or_shared(corner_colors, 4, b);
        call.flat_channels = flat_colors ? static_cast<int>(flat_colors->size(-1)) : 0;
        call.corner_channels = corner_colors ? static_cast<int>(corner_colors->size(-1)) : 0;
        call.opacities = opacities.data();
        call.sigmas = sigmas.data();
        call.shared_sigma = sigmas.rank() == 0;
        call.viewmat = viewmats.row(b);
        call.K = Ks.row(b);
        call.background = row_or_null(backgrounds, b);
        call.kernel_table = data_or_null(kernel_table);
        call.width = static_cast<int>(alpha.size(2));
        call.height = static_cast<int>(alpha.size(1));
        call.kernel = kernel;
        call.distance = distance;
        call.freeze_inradius = freeze_inradius;
        call.near_plane = near_plane;
        call.alpha_min = alpha_min;
        call.alpha_max = alpha_max;
        call.x_max = x_max;
        call.transmittance_min = transmittance_min;
        call.distortion_near = distortion_near;
        call.distortion_far = distortion_far;
        call.centroid_depth = centroid_depth;
        call.color = color.row(b);
        call.alpha = alpha.row(b);
        call.distortion = row_or_null(distortion, b);
        call.distortion_totals = row_or_null(distortion_totals, b);
        return call;
    }

    // Of view b, where an array with that many axes has values for each view.
    template <class T>
    static T* own_or_shared(const OptionalArray<T>& array, int axes, int64_t b) {
        return array && array->rank() == axes ? array->row(b) : data_or_null(array);
    }
};

// Cotangents of the images, shaped like them, and what is added to: by the inputs, shaped like them.
struct RasterBatchGradients : ArgumentGroup {
    Array<const float, 4> grad_color;
    OptionalArray<const float, 4> grad_alpha, grad_distortion;
    OptionalArray<float> vertices, flat_colors, corner_colors, opacities, sigmas;
    OptionalArray<float, 3> viewmats, Ks;
    OptionalArray<float, 2> backgrounds;

    RasterGradients view(int64_t b) const {
        RasterGradients call;
        call.grad_color = grad_color.row(b);
        call.grad_alpha = row_or_null(grad_alpha, b);
        call.grad_distortion = row_or_null(grad_distortion, b);
        call.vertices = data_or_null(vertices);
        call.flat_colors = RasterBatch::own_or_shared(flat_colors, 3, b);
        call.corner_colors = RasterBatch::own_or_shared(corner_colors, 4, b);
        call.opacities = data_or_null(opacities);
        call.sigmas = data_or_null(sigmas);
        call.background = row_or_null(backgrounds, b);
        call.viewmat = row_or_null(viewmats, b);
        call.K = row_or_null(Ks, b);
        return call;
    }
};

void bind_diagnostics(nb::module_& m) {
    m.def("available_instruction_sets", &available_instruction_sets);
    m.def("instruction_set", &instruction_set);
    m.def("set_instruction_set", &set_instruction_set, nb::arg("name"));
    m.def("kernel_names", &kernel_names);
    nb::class_<TileCounts>(m, "TileCounts")
        .def_ro("pairs", &TileCounts::pairs)
        .def_ro("forward_vectors", &TileCounts::forward_vectors)
        .def_ro("backward_vectors", &TileCounts::backward_vectors)
        .def_ro("drawn", &TileCounts::drawn);
    nb::class_<KernelNanoseconds>(m, "KernelNanoseconds")
        .def_ro("value", &KernelNanoseconds::value)
        .def_ro("gradient", &KernelNanoseconds::gradient);
    def_function(m, "count_tiles", [](const RasterState& state) { return count_tiles(state); }, "state");
    def_function(
        m, "time_kernel", [](int kernel, float sigma) { return time_kernel(kernel, sigma); }, "kernel", "sigma");
}

}  // namespace

void bind_rasterize(nb::module_& m) {
    nb::class_<RasterState>(m, "RasterState")
        .def_prop_ro("bytes", &RasterState::bytes)
        .def_prop_ro("num_pairs", [](const RasterState& state) { return state.num_slots; })
        .def_prop_ro("stage_seconds", [](const RasterState& state) {  // stage -> (wall, inside parallel_for)
            nb::typed<nb::dict, nb::str, nb::typed<nb::tuple, nb::float_, nb::float_>> seconds;
            for (int i = 0; i < kStages; ++i)
                seconds[kStageNames[i]] = nb::make_tuple(state.stages[i].wall, state.stages[i].parallel);
            return seconds;
        });
#define MEMBER(name) std::pair(#name, &RasterBatch::name)
    def_group(m, "RasterBatch", MEMBER(vertices), MEMBER(faces), MEMBER(flat_colors), MEMBER(corner_colors),
              MEMBER(opacities), MEMBER(sigmas), MEMBER(viewmats), MEMBER(Ks), MEMBER(backgrounds), MEMBER(kernel_table),
              MEMBER(kernel), MEMBER(distance), MEMBER(freeze_inradius), MEMBER(near_plane), MEMBER(alpha_min),
              MEMBER(alpha_max), MEMBER(x_max), MEMBER(transmittance_min), MEMBER(distortion_near),
              MEMBER(distortion_far), MEMBER(centroid_depth), MEMBER(color), MEMBER(alpha), MEMBER(distortion),
              MEMBER(distortion_totals));
#undef MEMBER
#define MEMBER(name) std::pair(#name, &RasterBatchGradients::name)
    def_group(m, "RasterGradients", MEMBER(grad_color), MEMBER(grad_alpha), MEMBER(grad_distortion),
              MEMBER(vertices), MEMBER(flat_colors),
              MEMBER(corner_colors), MEMBER(opacities), MEMBER(sigmas), MEMBER(viewmats), MEMBER(Ks),
              MEMBER(backgrounds));
#undef MEMBER
    // View after view: the median triangle (B, H, W) of each pixel, and statistics (B, N) of the triangles.
    def_function(
        m, "raster_forward",
        [](const RasterBatch& batch, bool keep_for_backward, OptionalArray<int32_t, 3> median_triangle,
           OptionalArray<float, 2> max_weight, OptionalArray<float, 2> screen_size, OptionalArray<float, 2> inradius,
           OptionalArray<bool, 2> visible) {
            std::vector<std::shared_ptr<RasterState>> states;
            for (int64_t b = 0; b < batch.viewmats.size(0); ++b) {
                RasterCall call = batch.view(b);
                call.keep_for_backward = keep_for_backward;
                call.median_triangle = row_or_null(median_triangle, b);
                call.max_weight = row_or_null(max_weight, b);
                call.screen_size = row_or_null(screen_size, b);
                call.inradius = row_or_null(inradius, b);
                call.visible = row_or_null(visible, b);
                states.push_back(raster_forward(call));
            }
            return states;
        },
        "batch", "keep_for_backward", "median_triangle", "max_weight", "screen_size", "inradius", "visible");
    def_function(
        m, "raster_backward",
        [](const std::vector<std::shared_ptr<RasterState>>& states, const RasterBatch& batch,
           const RasterBatchGradients& gradients) {
            for (size_t b = 0; b < states.size(); ++b) {
                const int64_t view = static_cast<int64_t>(b);
                raster_backward(*states[b], batch.view(view), gradients.view(view));
            }
        },
        "states", "batch", "gradients");
    bind_diagnostics(m);
}

}  // namespace etsplat
