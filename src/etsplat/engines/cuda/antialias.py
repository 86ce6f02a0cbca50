"""The GPU engine's side of ``rasterize_antialiased``: csrc/cuda/antialias.cu and shading.h, view by view."""

import ctypes
from typing import Any

import torch
from torch import Tensor

from etsplat import _native
from etsplat.core.validation import dense
from etsplat.engines.cuda.capacity import check_summed
from etsplat.engines.cuda.launch import BLOCK, blocks, launch, launch_each
from etsplat.engines.cuda.program import Program
from etsplat.engines.cuda.structs import Struct, struct_class
from etsplat.engines.native.operation import differentiable

_PROGRAM = Program("antialias.cu", contract=False)
_FILE, _SHADING = "cuda/antialias.cu", "cuda/shading.h"
_POINT = 3  # 64-bit words


_PER_PIXEL = 3
"""Values that a pixel adds to a vertex at most: of its colour's place, and of two silhouettes."""

_COLORS_OF = -2
"""Its place among the arguments of `antialias`."""


def _forward(keep: bool, *given: Any) -> tuple[Tensor, Any]:
    """Shading and blending of what the z-buffer has found."""
    vertices, colors, _, viewmats, _, triangle, *_, connectivity = given
    B, V, F = len(viewmats), len(vertices), len(connectivity.faces)
    points = torch.empty((B, V, _POINT), dtype=torch.int64, device=vertices.device)
    silhouettes = torch.empty((B, F), dtype=torch.uint8, device=vertices.device)
    shaded = vertices.new_empty((*triangle.shape, colors.shape[-1]))
    pixels = shaded.shape[1] * shaded.shape[2]
    if keep:
        check_summed("rasterize_antialiased", pixels, _PER_PIXEL)
    image = torch.empty_like(shaded)
    for b in range(B):
        scene = _scene(b, points, silhouettes, *given)
        launch_each(_PROGRAM, "antialias_points", V, (scene.view, points[b]))
        launch_each(_PROGRAM, "antialias_silhouettes", F, (scene.view, points[b], silhouettes[b]))
        launch_each(_PROGRAM, "shade_forward", pixels, (scene.view.shaded, shaded[b]))
        launch_each(_PROGRAM, "antialias_blend", pixels, (scene, shaded[b], image[b]))
    return image, (shaded, points, silhouettes, *given)


def _backward(kept: Any, needed: Any, grad_image: Tensor) -> list[Tensor | None]:
    """By vertices, colours and backgrounds; the same bits in every run."""
    shaded, *problem = kept
    grad_shaded = torch.empty_like(shaded[0])
    inputs = zip(problem[2:5], needed, strict=False)
    grads = [torch.zeros_like(tensor) if wanted else None for tensor, wanted in inputs]
    of_pixels = problem[_COLORS_OF] == "pixels"
    for b in range(len(shaded)):
        scene, pixels = _scene(b, *problem), shaded[b].shape[0] * shaded[b].shape[1]
        launch_each(_PROGRAM, "antialias_unblend", pixels, (scene, grad_image[b], grad_shaded))
        parts = grads[:2]
        if grads[2] is not None:
            _sum_background(scene.view.shaded, pixels, grad_shaded, grads[2][b])
        if of_pixels and grads[1] is not None:
            launch_each(_PROGRAM, "shade_pixels", pixels, (scene.view.shaded, grad_shaded, grads[1][b]))
            parts[1] = None
        _add_sums("antialias", pixels, (scene, shaded[b], grad_image[b], grad_shaded), parts)
    return grads


def _add_sums(kernels: str, pixels: int, arguments: tuple[Any, ...], parts: list[Tensor | None]) -> None:
    """Adds what the pixels of a view give to gradients by vertices and colours, but to those of None."""
    sums = [None if g is None else torch.zeros(g.shape, dtype=torch.int64, device=g.device) for g in parts]
    largest = torch.zeros(len(parts), dtype=torch.int32, device=arguments[-1].device)
    arguments = (*arguments, struct_class(_SHADING, "Targets")(*sums, largest))
    launch_each(_PROGRAM, f"{kernels}_measure", pixels, arguments)
    launch_each(_PROGRAM, f"{kernels}_scatter", pixels, arguments)
    for i, (total, gradient) in enumerate(zip(sums, parts, strict=True)):
        if total is not None and gradient is not None:
            count = gradient.numel()
            launch_each(_PROGRAM, "antialias_finish", count, (total, largest[i:], ctypes.c_int64(count), gradient))


def _sum_background(view: Struct, pixels: int, grad_shaded: Tensor, gradient: Tensor) -> None:
    """The gradient of one view's background."""
    rows, channels = blocks(pixels, BLOCK), len(gradient)
    sums = torch.empty((rows, channels), dtype=torch.float64, device=gradient.device)
    launch_each(_PROGRAM, "background_sums", pixels, (view, grad_shaded, sums))
    launch(_PROGRAM, "background_gradient", channels, BLOCK, (sums, ctypes.c_int64(rows), channels, gradient))


def _scene(b: int, points: Tensor, silhouettes: Tensor, *given: Any) -> Struct:
    """View b, as the kernels read it, where its arrays lie now."""
    vertices, colors, backgrounds, viewmats, Ks, triangle, barycentrics, depth, *settings = given
    near_plane, colors_of, connectivity = settings
    mine = colors[b] if colors_of == "pixels" else colors
    seen = viewmats, Ks, connectivity.faces, triangle, barycentrics
    shaded = _shaded(b, vertices, mine, *seen, colors_of, backgrounds)
    pairs = connectivity.pair_offsets, connectivity.paired_faces
    view = struct_class(_FILE, "AntialiasView")(shaded, depth[b], *pairs, near_plane)
    return struct_class(_FILE, "Scene")(view, points[b], silhouettes[b])


def _shaded(
    b: int,
    vertices: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    faces: Tensor,
    triangle: Tensor,
    barycentrics: Tensor,
    colors_of: str = "corners",
    backgrounds: Tensor | None = None,
) -> Struct:
    """View b with what is shaded, where its arrays lie now."""
    background = None if backgrounds is None else backgrounds[b]
    arrays = vertices, viewmats[b], Ks[b], barycentrics[b], colors, background, faces, triangle[b]
    kind, (height, width) = int(_native.ColorsOf[colors_of.upper()]), triangle.shape[1:]
    sizes = len(vertices), len(faces), width, height, colors.shape[-1], kind
    return struct_class(_SHADING, "ShadedView")(*arrays, *sizes)


def _interpolate_forward(keep: bool, *given: Any) -> tuple[Tensor, Any]:
    """Values of corners at pixels."""
    image = given[0].new_empty((*given[5].shape, given[1].shape[-1]))  # triangle, values
    pixels = image.shape[1] * image.shape[2]
    if keep:
        check_summed("rasterize_antialiased", pixels, _PER_PIXEL)
    for b in range(len(image)):
        launch_each(_PROGRAM, "shade_forward", pixels, (_shaded(b, *given), image[b]))
    return image, given


def _interpolate_backward(kept: Any, needed: Any, grad_image: Tensor) -> list[Tensor | None]:
    """By vertices and values; the same bits in every run."""
    grads = [torch.zeros_like(tensor) if wanted else None for tensor, wanted in zip(kept[:2], needed, strict=False)]
    pixels = grad_image.shape[1] * grad_image.shape[2]
    for b in range(len(grad_image)):
        _add_sums("shade", pixels, (_shaded(b, *kept), grad_image[b]), grads)
    return grads


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
    given: list[Any] = [dense(tensor) for tensor in (vertices, uvs, viewmats, Ks, faces, triangle, barycentrics)]
    depth, lod = dense(depth), vertices.new_empty(triangle.shape)
    for b in range(len(lod)):
        launch_each(_PROGRAM, "texture_detail", lod[b].numel(), (_shaded(b, *given), depth[b], width, height, lod[b]))
    return lod


antialias = differentiable(_forward, _backward)
interpolate = differentiable(_interpolate_forward, _interpolate_backward)
