"""The CPU engine's side of `rasterize_antialiased`: csrc/cpu/antialias.cpp and shading.cpp, view by view."""

from typing import Any

import torch
from torch import Tensor

from etsplat import _native
from etsplat.core.cameras import Cameras
from etsplat.core.connectivity import MeshConnectivity
from etsplat.core.validation import dense
from etsplat.engines.native.operation import differentiable
from etsplat.engines.native.pool import empty_image, zeros_image


def _forward(_keep: bool, *given: Any) -> tuple[Tensor, Any]:
    """Shading and blending of what the z-buffer has found."""
    shape = *given[5].shape, given[1].shape[-1]  # triangle, colours
    shaded, image = empty_image(*shape), empty_image(*shape)
    views, silhouettes = _problem(*given)
    states = _native.antialias_forward(views=views, silhouettes=silhouettes, shaded=shaded, color=image)
    return image, (*given, shaded, states)


def _backward(kept: Any, needed: Any, grad_image: Tensor) -> list[Tensor | None]:
    """By vertices, colours and backgrounds."""
    *given, shaded, states = kept
    grads = [zeros_image(*tensor.shape) if wanted else None for tensor, wanted in zip(given[:3], needed, strict=False)]
    views, silhouettes = _problem(*given)
    _native.antialias_backward(
        states=states,
        views=views,
        silhouettes=silhouettes,
        grad_color=grad_image,
        shaded=shaded,
        scratch=empty_image(*shaded.shape[1:]),
        grad_vertices=grads[0],
        grad_colors=grads[1],
        grad_backgrounds=grads[2],
    )
    return grads


def _problem(
    vertices: Tensor,
    colors: Tensor,
    backgrounds: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    triangle: Tensor,
    barycentrics: Tensor,
    depth: Tensor,
    near_plane: float,
    colors_of: str,
    connectivity: MeshConnectivity,
) -> tuple[_native.ShadedViews, _native.Silhouettes]:
    """With the arrays where they lie now."""
    views = _native.ShadedViews(
        vertices=vertices,
        faces=connectivity.faces,
        viewmats=viewmats,
        Ks=Ks,
        triangle=triangle,
        barycentrics=barycentrics,
        colors=colors,
        colors_of=_native.ColorsOf[colors_of.upper()],
        backgrounds=backgrounds,
    )
    return views, _native.Silhouettes(
        near_plane=near_plane,
        pair_offsets=connectivity.pair_offsets,
        paired_faces=connectivity.paired_faces,
        depth=depth,
    )


def _interpolate_forward(_keep: bool, *given: Tensor) -> tuple[Tensor, Any]:
    """Values of corners at pixels."""
    image = empty_image(*given[5].shape, given[1].shape[-1])  # triangle, values
    _native.shade(views=_corners(*given), shaded=image)
    return image, given


def _interpolate_backward(kept: Any, needed: Any, grad_image: Tensor) -> list[Tensor | None]:
    """By vertices and values."""
    grads = [zeros_image(*tensor.shape) if wanted else None for tensor, wanted in zip(kept[:2], needed, strict=False)]
    _native.shade_backward(views=_corners(*kept), grad_shaded=grad_image, grad_vertices=grads[0], grad_colors=grads[1])
    return grads


def _corners(
    vertices: Tensor,
    values: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    faces: Tensor,
    triangle: Tensor,
    barycentrics: Tensor,
) -> _native.ShadedViews:
    return _native.ShadedViews(
        vertices=vertices,
        faces=faces,
        viewmats=viewmats,
        Ks=Ks,
        triangle=triangle,
        barycentrics=barycentrics,
        colors=values,
        colors_of=_native.ColorsOf.CORNERS,
        backgrounds=None,
    )


def texture_detail(
    vertices: Tensor,
    uvs: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    faces: Tensor,
    triangle: Tensor,
    barycentrics: Tensor,
    depth: Tensor,
    width: int,
    height: int,
) -> Tensor:
    """See `Engine.texture_detail`."""
    given = (dense(tensor) for tensor in (vertices, uvs, viewmats, Ks, faces, triangle, barycentrics))
    lod = empty_image(*triangle.shape)
    _native.texture_detail(views=_corners(*given), depth=dense(depth), width=width, height=height, lod=lod)
    return lod


def rasterize_behind(
    vertices: Tensor,
    colors: Tensor,
    background: Tensor,
    cameras: Cameras,
    near_plane: float,
    connectivity: MeshConnectivity,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Colours, triangles, barycentrics and depths (2, H, W, ...): of the nearest triangles and of those behind."""
    vertices, colors = dense(vertices.detach()), dense(colors.detach())
    backgrounds, viewmats, Ks = (
        dense(tensor.expand(2, *tensor.shape[1:])) for tensor in (background, cameras.viewmats, cameras.Ks)
    )
    shape = 2, cameras.height, cameras.width
    triangle = torch.empty(shape, dtype=torch.int32)
    barycentrics, depth = empty_image(*shape, 3), empty_image(*shape)
    _native.rasterize_behind(
        vertices=vertices,
        faces=connectivity.faces,
        viewmat=viewmats[0],
        K=Ks[0],
        near_plane=near_plane,
        triangle=triangle,
        barycentrics=barycentrics,
        depth=depth,
    )
    shaded, image = empty_image(*shape, colors.shape[1]), empty_image(*shape, colors.shape[1])
    drawn, silhouettes = _problem(
        vertices,
        colors,
        backgrounds,
        viewmats,
        Ks,
        triangle,
        barycentrics,
        depth,
        near_plane,
        "vertices",
        connectivity,
    )
    _native.antialias_behind(views=drawn, silhouettes=silhouettes, shaded=shaded, color=image)
    return image, triangle, barycentrics, depth


antialias = differentiable(_forward, _backward)
interpolate = differentiable(_interpolate_forward, _interpolate_backward)
