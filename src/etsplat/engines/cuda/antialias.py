"""The GPU engine's side of ``rasterize_antialiased``: csrc/cuda/antialias.cu, one view after the other."""

import ctypes
from typing import Any

import torch
from torch import Tensor

from etsplat.engines.cuda.capacity import check_summed
from etsplat.engines.cuda.launch import launch_each
from etsplat.engines.cuda.program import Program
from etsplat.engines.cuda.structs import Struct, struct_class
from etsplat.engines.native.operation import differentiable

_PROGRAM = Program("antialias.cu", contract=False)
_FILE = "cuda/antialias.cu"
_POINT = 3  # 64-bit words


_PER_PIXEL = 3
"""Values that a pixel adds to a vertex at most: of its colour's place, and of two silhouettes."""


def _forward(keep: bool, *given: Any) -> tuple[Tensor, Any]:
    """Shading and blending of what the z-buffer has found."""
    vertices, colors, _, viewmats, _, triangle, *_, connectivity = given
    B, V, F = len(viewmats), len(vertices), len(connectivity.faces)
    points = torch.empty((B, V, _POINT), dtype=torch.int64, device=vertices.device)
    silhouettes = torch.empty((B, F), dtype=torch.uint8, device=vertices.device)
    shaded = vertices.new_empty((*triangle.shape, colors.shape[1]))
    pixels = shaded.shape[1] * shaded.shape[2]
    if keep:
        check_summed("rasterize_antialiased", pixels, _PER_PIXEL)
    image = torch.empty_like(shaded)
    for b in range(B):
        scene = _scene(b, points, silhouettes, *given)
        launch_each(_PROGRAM, "antialias_points", V, (scene.view, points[b]))
        launch_each(_PROGRAM, "antialias_silhouettes", F, (scene.view, points[b], silhouettes[b]))
        launch_each(_PROGRAM, "antialias_shade", pixels, (scene.view, shaded[b]))
        launch_each(_PROGRAM, "antialias_blend", pixels, (scene, shaded[b], image[b]))
    return image, (shaded, points, silhouettes, *given)


def _backward(kept: Any, needed: Any, grad_image: Tensor) -> list[Tensor | None]:
    """By vertices, colours and backgrounds; the same bits in every run."""
    shaded, *problem = kept
    grad_shaded = torch.empty_like(shaded[0])
    inputs = zip(problem[2:5], needed, strict=False)
    grads = [torch.zeros_like(tensor) if wanted else None for tensor, wanted in inputs]
    for b in range(len(shaded)):
        parts = [grads[0], grads[1], None if grads[2] is None else grads[2][b]]
        sums = [None if g is None else torch.zeros(g.shape, dtype=torch.int64, device=g.device) for g in parts]
        largest = torch.zeros(3, dtype=torch.int32, device=shaded.device)
        scene, pixels = _scene(b, *problem), shaded[b].shape[0] * shaded[b].shape[1]
        launch_each(_PROGRAM, "antialias_unblend", pixels, (scene, grad_image[b], grad_shaded))
        arguments = (scene, shaded[b], grad_image[b], grad_shaded, struct_class(_FILE, "Targets")(*sums, largest))
        launch_each(_PROGRAM, "antialias_measure", pixels, arguments)
        launch_each(_PROGRAM, "antialias_scatter", pixels, arguments)
        for i, (total, gradient) in enumerate(zip(sums, parts, strict=True)):
            if total is not None and gradient is not None:
                count = gradient.numel()
                arguments = (total, largest[i:], ctypes.c_int64(count), gradient)
                launch_each(_PROGRAM, "antialias_finish", count, arguments)
    return grads


def _scene(b: int, points: Tensor, silhouettes: Tensor, *given: Any) -> Struct:
    """View b, as the kernels read it, where its arrays lie now."""
    vertices, colors, backgrounds, viewmats, Ks, triangle, barycentrics, depth, *settings = given
    near_plane, per_face, connectivity = settings
    faces, (height, width) = connectivity.faces, triangle.shape[1:]
    floats = (vertices, viewmats[b], Ks[b], barycentrics[b], depth[b], colors, backgrounds[b])
    integers = (faces, connectivity.pair_offsets, connectivity.paired_faces, triangle[b])
    sizes = len(vertices), len(faces), width, height, colors.shape[1], per_face
    view = struct_class(_FILE, "AntialiasView")(*floats, *integers, *sizes, near_plane)
    return struct_class(_FILE, "Scene")(view, points[b], silhouettes[b])


antialias = differentiable(_forward, _backward)
