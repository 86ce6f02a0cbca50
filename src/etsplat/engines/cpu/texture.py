"""The CPU engine's side of `sample_texture`: csrc/cpu/texture.cpp."""

from typing import Any

from torch import Tensor

from etsplat import _native
from etsplat.engines.native.operation import differentiable
from etsplat.engines.native.pool import empty_image
from etsplat.engines.native.texture import coarser_size


def _forward(_keep: bool, texture: Tensor, uv: Tensor, lod: Tensor | None, levels: int) -> tuple[Tensor, Any]:
    """With the coarser levels, which gradients by places take too."""
    coarser = None if levels == 1 else empty_image(coarser_size(texture, levels))
    if coarser is not None:
        _native.texture_levels(texture=texture, levels=levels, coarser=coarser)
    values = empty_image(len(uv), texture.shape[2])
    _native.sample_texture(sampled=_sampled(texture, coarser, levels, uv, lod), values=values)
    return values, (texture, coarser, levels, uv, lod)


def _backward(kept: Any, needed: Any, grad_values: Tensor) -> tuple[Tensor | None, Tensor | None]:
    """By texels and places."""
    texture, coarser, _, uv, _ = kept
    grad_texture = empty_image(*texture.shape) if needed[0] else None
    grad_uv = empty_image(*uv.shape) if needed[1] else None
    _native.sample_texture_backward(
        sampled=_sampled(*kept),
        grad_values=grad_values,
        grad_texture=grad_texture,
        grad_coarser=empty_image(len(coarser)) if needed[0] and coarser is not None else None,
        grad_uv=grad_uv,
    )
    return grad_texture, grad_uv


def _sampled(
    texture: Tensor, coarser: Tensor | None, levels: int, uv: Tensor, lod: Tensor | None
) -> _native.SampledTexture:
    """With the arrays where they lie now."""
    return _native.SampledTexture(texture=texture, coarser=coarser, levels=levels, uv=uv, lod=lod)


sample_texture = differentiable(_forward, _backward)
