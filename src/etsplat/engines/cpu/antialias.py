"""The CPU engine's side of `rasterize_antialiased`: csrc/cpu/antialias.cpp, one view after the other."""

from typing import Any

from torch import Tensor

from etsplat import _native
from etsplat.core.connectivity import MeshConnectivity
from etsplat.engines.native.operation import differentiable
from etsplat.engines.native.pool import empty_image, zeros_image


def _forward(_keep: bool, *given: Any) -> tuple[Tensor, Any]:
    """Shading and blending of what the z-buffer has found."""
    shape = *given[5].shape, given[1].shape[1]  # triangle, colours
    shaded, image = empty_image(*shape), empty_image(*shape)
    states = _native.antialias_forward(views=_views(*given), shaded=shaded, color=image)
    return image, (*given, shaded, states)


def _backward(kept: Any, needed: Any, grad_image: Tensor) -> list[Tensor | None]:
    """By vertices, colours and backgrounds."""
    *given, shaded, states = kept
    grads = [zeros_image(*tensor.shape) if wanted else None for tensor, wanted in zip(given[:3], needed, strict=False)]
    _native.antialias_backward(
        states=states,
        views=_views(*given),
        grad_color=grad_image,
        shaded=shaded,
        scratch=empty_image(*shaded.shape[1:]),
        grad_vertices=grads[0],
        grad_colors=grads[1],
        grad_backgrounds=grads[2],
    )
    return grads


def _views(
    vertices: Tensor,
    colors: Tensor,
    backgrounds: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    triangle: Tensor,
    barycentrics: Tensor,
    depth: Tensor,
    near_plane: float,
    per_face: bool,
    connectivity: MeshConnectivity,
) -> _native.AntialiasViews:
    """With the arrays where they lie now."""
    return _native.AntialiasViews(
        vertices=vertices,
        faces=connectivity.faces,
        viewmats=viewmats,
        Ks=Ks,
        near_plane=near_plane,
        pair_offsets=connectivity.pair_offsets,
        paired_faces=connectivity.paired_faces,
        triangle=triangle,
        barycentrics=barycentrics,
        depth=depth,
        colors=colors,
        per_face=per_face,
        backgrounds=backgrounds,
    )


antialias = differentiable(_forward, _backward)
