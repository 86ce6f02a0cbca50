#include "instruction_set.h"

#include <atomic>
#include <stdexcept>

#include "simd/paths.h"

#if defined(ETSPLAT_X86)
#if defined(_MSC_VER)
#include <intrin.h>
#else
#include <cpuid.h>
#endif
#endif

namespace etsplat {
namespace {

struct Path {
    std::string name;
    RasterKernels raster;
    TriangleKernels triangles;
    PhotometricKernels photometric;
    NormalsKernels normals;
    OpaqueKernels opaque;
    ColorsKernels colors;
    PlaneSweepKernels plane_sweep;
};

#if defined(ETSPLAT_X86)
// The processor is asked itself: with Zig's runtime library __builtin_cpu_supports is always false.
struct Registers {
    unsigned ebx = 0, ecx = 0;
};

Registers cpuid(unsigned leaf) {
    Registers r;  // zeros where the processor has no such leaf
#if defined(_MSC_VER)
    int v[4];
    __cpuid(v, 0);
    if (static_cast<unsigned>(v[0]) < leaf) return r;
    __cpuidex(v, static_cast<int>(leaf), 0);
    r.ebx = static_cast<unsigned>(v[1]);
    r.ecx = static_cast<unsigned>(v[2]);
#else
    unsigned eax, edx;
    __get_cpuid_count(leaf, 0, &eax, &r.ebx, &r.ecx, &edx);
#endif
    return r;
}

// Whether the operating system saves all these parts of the registers (XCR0).
bool system_saves(unsigned parts) {
    if (!(cpuid(1).ecx & 1u << 27)) return false;  // OSXSAVE: XCR0 can be read
#if defined(_MSC_VER)
    const auto saved = static_cast<unsigned>(_xgetbv(0));
#else
    unsigned saved, high;
    __asm__("xgetbv" : "=a"(saved), "=d"(high) : "c"(0));
#endif
    return (saved & parts) == parts;
}

bool has_avx2() {
    const unsigned fma = 1u << 12, avx2 = 1u << 5;
    return system_saves(0x6) && (cpuid(1).ecx & fma) && (cpuid(7).ebx & avx2);
}

bool has_avx512() {
    const unsigned needed = 1u << 16 | 1u << 17 | 1u << 30 | 1u << 31;  // F, DQ, BW, VL
    return has_avx2() && system_saves(0xe6) && (cpuid(7).ebx & needed) == needed;
}
#endif

#define ETSPLAT_PATH(name)                                                                                         \
    Path {                                                                                                         \
        #name,                   name::raster_kernels(), name::triangle_kernels(), name::photometric_kernels(),    \
        name::normals_kernels(), name::opaque_kernels(), name::colors_kernels(),   name::plane_sweep_kernels()     \
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

const OpaqueKernels& active_opaque_kernels() { return active().opaque; }

const ColorsKernels& active_colors_kernels() { return active().colors; }

const PlaneSweepKernels& active_plane_sweep_kernels() { return active().plane_sweep; }

}  // namespace etsplat
