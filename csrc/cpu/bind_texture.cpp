#include "bindings.h"
#include "texture.h"

namespace etsplat {
namespace {

Texture described(const Array<const float, 3>& texture, const float* coarser, int levels) {
    return {texture.data(), coarser, static_cast<int>(texture.size(1)), static_cast<int>(texture.size(0)),
            static_cast<int>(texture.size(2)), levels};
}

// A texture, and where it is sampled.
struct SampledTexture : ArgumentGroup {
    Array<const float, 3> texture;          // (H, W, C)
    OptionalArray<const float, 1> coarser;  // levels 1, 2, ..., as `texture_levels` filled them; None: there are none
    int levels;
    Array<const float, 2> uv;           // (N, 2)
    OptionalArray<const float, 1> lod;  // (N,); None: level 0

    Texture of() const { return described(texture, data_or_null(coarser), levels); }
    TextureSamples samples() const { return {uv.data(), data_or_null(lod), uv.size(0)}; }
};

}  // namespace

void bind_texture(nb::module_& m) {
    // texture (H, W, C), sides that can be halved levels - 1 times; coarser (H W C (1/4 + 1/16 + ...),) is written.
    def_function(
        m, "texture_levels",
        [](Array<const float, 3> texture, int levels, Array<float, 1> coarser) {
            build_levels(described(texture, coarser.data(), levels), coarser.data());
        },
        "texture", "levels", "coarser");
#define MEMBER(name) std::pair(#name, &SampledTexture::name)
    def_group(m, "SampledTexture", MEMBER(texture), MEMBER(coarser), MEMBER(levels), MEMBER(uv), MEMBER(lod));
#undef MEMBER
    // values (N, C) is written.
    def_function(
        m, "sample_texture",
        [](const SampledTexture& sampled, Array<float, 2> values) {
            sample_texture(sampled.of(), sampled.samples(), values.data());
        },
        "sampled", "values");
    // grad_values (N, C); grad_texture (H, W, C), with grad_coarser as room for its levels, and grad_uv (N, 2) are
    // written.
    def_function(
        m, "sample_texture_backward",
        [](const SampledTexture& sampled, Array<const float, 2> grad_values, OptionalArray<float, 3> grad_texture,
           OptionalArray<float, 1> grad_coarser, OptionalArray<float, 2> grad_uv) {
            const Texture texture = sampled.of();
            const TextureSamples samples = sampled.samples();
            if (grad_texture) {
                sample_texture_by_texels(texture, samples, grad_values.data(), grad_texture->data(),
                                         data_or_null(grad_coarser));
            }
            if (grad_uv) sample_texture_by_uv(texture, samples, grad_values.data(), grad_uv->data());
        },
        "sampled", "grad_values", "grad_texture", "grad_coarser", "grad_uv");
}

}  // namespace etsplat
