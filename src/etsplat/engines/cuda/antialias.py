"""The GPU engine's side of ``rasterize_antialiased``: csrc/cuda/antialias.cu, one view after the other."""

import ctypes
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from etsplat.core.connectivity import MeshConnectivity
from etsplat.core.validation import dense
from etsplat.engines.cuda.launch import blocks, launch
from etsplat.engines.cuda.program import Program
from etsplat.engines.cuda.structs import struct_class

_PROGRAM = Program("antialias.cu", contract=False)
_THREADS = 256
_POINT = 3  # 64-bit words


class Antialias(torch.autograd.Function):
    """Shading and blending of what the z-buffer has found."""

    @staticmethod
    def forward(
        ctx: Any,
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
    ) -> Tensor:
        """See `Engine.antialias`."""
        found = triangle, barycentrics, depth
        inputs = [dense(tensor) for tensor in (vertices, colors, backgrounds, viewmats, Ks, *found)]
        B, V, F = len(viewmats), len(vertices), len(connectivity.faces)
        ctx.near_plane, ctx.per_face, ctx.connectivity = near_plane, per_face, connectivity
        points = torch.empty((B, V, _POINT), dtype=torch.int64, device=vertices.device)
        silhouettes = torch.empty((B, F), dtype=torch.uint8, device=vertices.device)
        shaded = vertices.new_empty((*triangle.shape, colors.shape[1]))
        pixels = shaded.shape[1] * shaded.shape[2]
        image = torch.empty_like(shaded)
        tensors = *inputs, points, silhouettes, shaded
        for b in range(B):
            scene = _scene(tensors, ctx, b)
            _run("antialias_points", V, (scene.view, points[b]))
            _run("antialias_silhouettes", F, (scene.view, points[b], silhouettes[b]))
            _run("antialias_shade", pixels, (scene.view, shaded[b]))
            _run("antialias_blend", pixels, (scene, shaded[b], image[b]))
        ctx.save_for_backward(*tensors)
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Gradients are the same bits in every run."""
        tensors = tuple(map(dense, ctx.saved_tensors))
        shaded, grad_image = tensors[-1], dense(grad_image)
        grad_shaded = torch.empty_like(shaded[0])
        grads = [
            torch.zeros_like(tensor) if needed else None
            for tensor, needed in zip(tensors[:3], ctx.needs_input_grad, strict=False)
        ]
        for b in range(len(shaded)):
            parts = [grads[0], grads[1], None if grads[2] is None else grads[2][b]]
            sums = [None if g is None else torch.zeros(g.shape, dtype=torch.int64, device=g.device) for g in parts]
            largest = torch.zeros(3, dtype=torch.int32, device=shaded.device)
            addresses = (None if tensor is None else tensor.data_ptr() for tensor in (*sums, largest))
            scene, pixels = _scene(tensors, ctx, b), shaded[b].shape[0] * shaded[b].shape[1]
            _run("antialias_unblend", pixels, (scene, grad_image[b], grad_shaded))
            arguments = (scene, shaded[b], grad_image[b], grad_shaded, _struct("Targets")(*addresses))
            _run("antialias_measure", pixels, arguments)
            _run("antialias_scatter", pixels, arguments)
            for i, (total, gradient) in enumerate(zip(sums, parts, strict=True)):
                if total is not None and gradient is not None:
                    count = gradient.numel()
                    _run("antialias_finish", count, (total, largest[i:], ctypes.c_int64(count), gradient))
        return *grads, *(None,) * 8


def _struct(name: str) -> Any:
    return struct_class("cuda/antialias.cu", name)


def _run(name: str, count: int, arguments: tuple[Any, ...]) -> None:
    launch(_PROGRAM, name, blocks(count, _THREADS), _THREADS, arguments)


def _scene(tensors: tuple[Tensor, ...], ctx: Any, b: int) -> Any:
    """View b, as the kernels read it, where its arrays lie now."""
    vertices, colors, backgrounds, viewmats, Ks, triangle, barycentrics, depth, points, silhouettes, shaded = tensors
    connectivity = ctx.connectivity
    floats = (vertices, viewmats[b], Ks[b], barycentrics[b], depth[b], colors, backgrounds[b])
    integers = (connectivity.faces, connectivity.pair_offsets, connectivity.paired_faces, triangle[b])
    view = _struct("AntialiasView")(
        *(tensor.data_ptr() for tensor in (*floats, *integers)),
        len(vertices),
        len(connectivity.faces),
        triangle.shape[2],
        triangle.shape[1],
        shaded.shape[-1],
        ctx.per_face,
        ctx.near_plane,
    )
    return _struct("Scene")(view, points[b].data_ptr(), silhouettes[b].data_ptr())
