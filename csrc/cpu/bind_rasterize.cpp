#include <nanobind/ndarray.h>
#include <nanobind/stl/shared_ptr.h>

#include "bindings.h"
#include "instruction_set.h"
#include "pool.h"
#include "raster.h"
#include "raster_diagnostics.h"

namespace etsplat {

void bind_rasterize(nb::module_& m) {
    m.def("pooled_floats", [](size_t count) {
        float* block = pool_acquire(count);
        nb::capsule owner(block, [](void* p) noexcept { pool_release(static_cast<float*>(p)); });
        return nb::ndarray<nb::numpy, float, nb::ndim<1>>(block, {count}, owner);
    }, nb::arg("count"));
    m.def("pool_idle_bytes", &pool_idle_bytes);
    m.def("available_instruction_sets", &available_instruction_sets);
    m.def("instruction_set", &instruction_set);
    m.def("set_instruction_set", &set_instruction_set, nb::arg("name"));

#define FIELD(name) .def_rw(#name, &RasterCall::name)
    nb::class_<RasterCall>(m, "RasterCall")
        .def(nb::init<>()) FIELD(vertices) FIELD(faces) FIELD(num_triangles) FIELD(num_vertices) FIELD(flat_colors)
        FIELD(corner_colors) FIELD(flat_channels) FIELD(corner_channels) FIELD(opacities) FIELD(sigmas)
        FIELD(shared_sigma) FIELD(viewmat) FIELD(K) FIELD(background) FIELD(width) FIELD(height) FIELD(kernel)
        FIELD(kernel_table) FIELD(distance) FIELD(freeze_inradius) FIELD(near_plane) FIELD(alpha_min) FIELD(alpha_max) FIELD(x_max)
        FIELD(transmittance_min) FIELD(distortion_near) FIELD(distortion_far) FIELD(centroid_depth)
        FIELD(keep_for_backward) FIELD(color) FIELD(alpha) FIELD(distortion) FIELD(distortion_totals)
        FIELD(median_triangle) FIELD(max_weight) FIELD(screen_size) FIELD(inradius) FIELD(visible);
#undef FIELD
#define FIELD(name) .def_rw(#name, &RasterGradients::name)
    nb::class_<RasterGradients>(m, "RasterGradients")
        .def(nb::init<>()) FIELD(grad_color) FIELD(grad_alpha) FIELD(grad_distortion) FIELD(corner_offsets)
        FIELD(corner_indices) FIELD(vertices) FIELD(flat_colors) FIELD(corner_colors) FIELD(opacities) FIELD(sigmas)
        FIELD(background) FIELD(viewmat) FIELD(K);
#undef FIELD
    nb::class_<RasterState>(m, "RasterState")
        .def_prop_ro("bytes", &RasterState::bytes)
        .def_prop_ro("num_pairs", [](const RasterState& state) { return state.num_slots; })
        .def_prop_ro("stage_seconds", [](const RasterState& state) {  // stage -> (wall, inside parallel_for)
            nb::dict seconds;
            for (int i = 0; i < kStages; ++i)
                seconds[kStageNames[i]] = nb::make_tuple(state.stages[i].wall, state.stages[i].parallel);
            return seconds;
        });
    nb::class_<TileCounts>(m, "TileCounts")
        .def_ro("pairs", &TileCounts::pairs)
        .def_ro("forward_vectors", &TileCounts::forward_vectors)
        .def_ro("backward_vectors", &TileCounts::backward_vectors)
        .def_ro("drawn", &TileCounts::drawn);
    nb::class_<KernelNanoseconds>(m, "KernelNanoseconds")
        .def_ro("value", &KernelNanoseconds::value)
        .def_ro("gradient", &KernelNanoseconds::gradient);
    m.def("count_tiles", &count_tiles, nb::arg("state"), NoGil());
    m.def("time_kernel", &time_kernel, nb::arg("kernel"), nb::arg("sigma"), nb::arg("kernel_table") = 0, NoGil());
    m.def("kernel_names", &kernel_names);
    m.def("raster_forward", &raster_forward, nb::arg("call"), NoGil());
    m.def("raster_backward", &raster_backward, nb::arg("state"), nb::arg("call"), nb::arg("gradients"), NoGil());
}

}  // namespace etsplat
