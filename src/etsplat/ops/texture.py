"""Textures: their values between texels, and between levels of detail.

Texture coordinates (u, v) are those of glTF: (0, 0) is the upper left corner of the texture, (1, 1) its lower right
one, v runs down, and the texel in row i and column j has its centre at ((j + 1/2) / W, (i + 1/2) / H). Level l + 1 has
the means of 2 x 2 texels of level l.
"""

from jaxtyping import Float
from torch import Tensor

from etsplat.core.precision import as_given
from etsplat.core.rasterization import Rasterization
from etsplat.core.validation import check_count, check_like, check_shape
from etsplat.engines.choice import engine_for

_MOST_SAMPLES = 2**31 - 1


@as_given
def sample_texture(
    texture: Float[Tensor, "H W C"],
    uv: Float[Tensor, "*N 2"],
    *,
    lod: Float[Tensor, "*N"] | None = None,
    max_level: int | None = None,
) -> Float[Tensor, "*N C"]:
    """Values of a texture, bilinear between the centres of texels; differentiable by texture and places.

    Args:
        texture: (H, W, C), row by row from the top.
        uv: (..., 2), u to the right and v down, both from 0 to 1 across the texture. Beyond the centres of its border
            the texture goes on as there, without a gradient; NaN counts as 0.
        lod: (...), level of detail of each sample: 0 is the texture itself, l the level whose texels are 2^l times as
            wide, and in between both are blended (trilinear). Below 0 it counts as 0. It has no gradient. None is 0.
        max_level: The coarsest level, with ``lod`` alone. None: there are levels down to the first with an odd side,
            which ends them in any case.

    Returns:
        (..., C). The native engines' values and gradients are the same bits in every run. Gradients of coarser levels
        go to the texture that they are the means of.

    Raises:
        ValueError: Wrong shape, dtype, device or number; the message names the argument.

    Example:
        >>> texture = torch.tensor([[[0.0], [1.0]]])  # a black texel, and a white one to the right
        >>> etsplat.sample_texture(texture, torch.tensor([[0.0, 0.5], [0.5, 0.5], [1.0, 0.5]])).flatten().tolist()
        [0.0, 0.5, 1.0]
    """
    check_shape("texture", texture, ("H", "W", "C"))
    if 0 in texture.shape:
        raise ValueError(f"texture must have a texel and a channel, got shape {tuple(texture.shape)}")
    check_shape("uv", uv, (*uv.shape[:-1], 2) if isinstance(uv, Tensor) and uv.ndim > 0 else ("N", 2))
    check_like("uv", uv, "texture", texture)
    if lod is not None:
        check_shape("lod", lod, tuple(uv.shape[:-1]))
        check_like("lod", lod, "texture", texture)
        lod = lod.detach().reshape(-1)
    elif max_level is not None:
        raise ValueError("max_level must be None without lod, which chooses between levels")
    levels = 1 if lod is None else count_levels(texture, max_level)
    places = uv.reshape(-1, 2)
    if len(places) > _MOST_SAMPLES:
        raise ValueError(f"uv must have {_MOST_SAMPLES} samples at most, got {len(places)}: take them in parts")
    values = engine_for(texture).sample_texture(texture, places, lod, levels)
    return values.reshape(*uv.shape[:-1], texture.shape[2])


def count_levels(texture: Float[Tensor, "H W C"], max_level: int | None) -> int:
    """How many levels a texture has, itself among them: it is halved while both of its sides are even.

    Raises:
        ValueError: ``max_level`` is neither None nor an integer of at least 0.
    """
    if max_level is not None:
        max_level = check_count("max_level", max_level, least=0)
    height, width = texture.shape[:2]
    levels = 1
    while height % 2 == width % 2 == 0 and (max_level is None or levels <= max_level):
        height, width, levels = height // 2, width // 2, levels + 1
    return levels


def texture_at_pixels(
    vertices: Tensor,
    texture: Tensor,
    face_uvs: Tensor,
    max_level: int | None,
    viewmats: Tensor,
    Ks: Tensor,
    faces: Tensor,
    seen: Rasterization,
) -> Float[Tensor, "B H W C"]:
    """What pixels show of a texture, in views that `rasterize_opaque` has seen.

    The arguments are those of `rasterize_antialiased`, faces of 32 bits. Where there is no triangle a pixel has the
    value of the texture's corner.
    """
    engine, levels, lod = engine_for(vertices), count_levels(texture, max_level), None
    assert seen.triangle is not None
    assert seen.barycentrics is not None
    assert seen.depth is not None
    places = viewmats, Ks, faces, seen.triangle, seen.barycentrics
    uv = engine.interpolate(vertices, face_uvs, *places)
    if levels > 1:
        height, width = texture.shape[:2]
        lod = engine.texture_detail(vertices, face_uvs, *places, seen.depth[..., 0], width, height).reshape(-1)
    values = engine.sample_texture(texture, uv.reshape(-1, 2), lod, levels)
    return values.reshape(*uv.shape[:-1], texture.shape[2])
