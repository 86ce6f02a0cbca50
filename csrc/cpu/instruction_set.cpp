#include "instruction_set.h"

#include <atomic>
#include <stdexcept>

#include "simd/paths.h"

#if defined(ETSPLAT_X86) && defined(_MSC_VER)
#include <intrin.h>
#endif

namespace etsplat {
namespace {

struct Path {
    std::string name;
    RasterKernels raster;
    TriangleKernels triangles;
    PhotometricKernels photometric;
    NormalsKernels normals;
};

#if defined(ETSPLAT_X86)
#if defined(_MSC_VER)
bool has_avx2() {
    int r[4];
    __cpuidex(r, 1, 0);
    const bool os_saves_ymm = (r[2] & (1 << 27)) && (_xgetbv(0) & 6) == 6, fma = r[2] & (1 << 12);
    __cpuidex(r, 7, 0);
    return os_saves_ymm && fma && (r[1] & (1 << 5));
}
bool has_avx512() {
    int r[4];
    __cpuidex(r, 7, 0);
    const int needed = (1 << 16) | (1 << 17) | (1 << 30) | (1 << 31);  // F, DQ, BW, VL
    return has_avx2() && (_xgetbv(0) & 0xe6) == 0xe6 && (r[1] & needed) == needed;
}
#else
bool has_avx2() { return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma"); }
bool has_avx512() {
    return has_avx2() && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
           __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl");
}
#endif
#endif

#define ETSPLAT_PATH(name)                                                                                          \
    Path {                                                                                                          \
        #name, name::raster_kernels(), name::triangle_kernels(), name::photometric_kernels(), name::normals_kernels() \
    }

const std::vector<Path>& paths() {
    static const std::vector<Path>& all = *[] {  // never destroyed: threads may still draw while the process ends
        auto* found = new std::vector<Path>;
#if defined(ETSPLAT_X86)
        if (has_avx512()) found->push_back(ETSPLAT_PATH(avx512));
        if (has_avx2()) found->push_back(ETSPLAT_PATH(avx2));
#elif defined(ETSPLAT_ARM64)
        found->push_back(ETSPLAT_PATH(neon));
#endif
        found->push_back(ETSPLAT_PATH(plain));
        return found;
    }();
    return all;
}

std::atomic<const Path*> chosen{nullptr};

const Path& active() {
    const Path* path = chosen.load(std::memory_order_acquire);
    return path ? *path : paths().front();
}

}  // namespace

std::vector<std::string> available_instruction_sets() {
    std::vector<std::string> names;
    for (const Path& path : paths()) names.push_back(path.name);
    return names;
}

std::string instruction_set() { return active().name; }

void set_instruction_set(const std::string& name) {
    if (name.empty()) {
        chosen = nullptr;
        return;
    }
    std::string known;
    for (const Path& path : paths()) {
        if (path.name == name) {
            chosen = &path;
            return;
        }
        known += (known.empty() ? "" : ", ") + path.name;
    }
    throw std::invalid_argument("instruction set '" + name + "' is not available here; choose one of: " + known);
}

const RasterKernels& active_raster_kernels() { return active().raster; }

const TriangleKernels& active_triangle_kernels() { return active().triangles; }

const PhotometricKernels& active_photometric_kernels() { return active().photometric; }

const NormalsKernels& active_normals_kernels() { return active().normals; }

}  // namespace etsplat
