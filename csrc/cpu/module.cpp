#include <cstdlib>
#include <exception>

#include "bindings.h"
#include "parallel.h"

#if !defined(_WIN32)
#include <unistd.h>
#endif

namespace etsplat {
void bind_adam(nb::module_& m);
void bind_antialias(nb::module_& m);
void bind_array_scans(nb::module_& m);
void bind_constants(nb::module_& m);
void bind_geometry(nb::module_& m);
void bind_halving_sums(nb::module_& m);
void bind_mesh_energies(nb::module_& m);
void bind_normals(nb::module_& m);
void bind_photo_agreement(nb::module_& m);
void bind_photometric(nb::module_& m);
void bind_plane_sweep(nb::module_& m);
void bind_pool(nb::module_& m);
void bind_rasterize(nb::module_& m);
void bind_rasterize_opaque(nb::module_& m);
void bind_silhouettes(nb::module_& m);
void bind_soup_activation(nb::module_& m);
void bind_soup_colors(nb::module_& m);
void bind_spherical_harmonics(nb::module_& m);
void bind_texture(nb::module_& m);
void bind_triangle_area(nb::module_& m);
void bind_triangle_channels(nb::module_& m);

namespace {

#if !defined(_WIN32)
std::terminate_handler other_handler = nullptr;

// Before Python 3.14 a thread that wants the GIL back while the interpreter ends is ended by pthread_exit, which unwinds
// its stack through destructors (of ours, of torch's) that may not throw: the process aborts. Such a thread waits here for
// the end of the process instead, as threads do from 3.14 on.
[[noreturn]] void outlast_the_interpreter() {
    while (!std::current_exception() && !Py_IsInitialized()) pause();
    if (other_handler) other_handler();
    std::abort();
}
#endif

}  // namespace
}  // namespace etsplat

NB_MODULE(_native, m) {
    using namespace etsplat;
    m.doc() = "Native code of etsplat. This file is made by `make stubs`.";
    nb::set_leak_warnings(false);  // tensors alive at interpreter exit keep their render states, which is no leak
#if !defined(_WIN32)
    other_handler = std::set_terminate(outlast_the_interpreter);
#endif
    load_torch();
    m.def("num_threads", &num_threads);
    m.def("set_num_threads", &set_num_threads, nb::arg("count"));
    m.def("parallel_seconds", &parallel_seconds);
    m.def("reset_parallel_seconds", &reset_parallel_seconds);
    bind_adam(m);
    bind_antialias(m);
    bind_array_scans(m);
    bind_constants(m);
    bind_geometry(m);
    bind_halving_sums(m);
    bind_mesh_energies(m);
    bind_normals(m);
    bind_photo_agreement(m);
    bind_photometric(m);
    bind_plane_sweep(m);
    bind_pool(m);
    bind_rasterize(m);
    bind_rasterize_opaque(m);
    bind_silhouettes(m);
    bind_soup_activation(m);
    bind_soup_colors(m);
    bind_spherical_harmonics(m);
    bind_texture(m);
    bind_triangle_area(m);
    bind_triangle_channels(m);
}
