"""The GPU engine's side of ``rasterize_antialiased``: csrc/cuda/antialias.cu, one view after the other."""

import ctypes
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from etsplat.core.validation import dense
from etsplat.cuda.launch import blocks, launch
from etsplat.cuda.program import Program
from etsplat.cuda.structs import struct_class

if TYPE_CHECKING:
    from etsplat.ops.mesh_energies import MeshConnectivity
    from etsplat.ops.rasterize_hard import HardRasterization

_PROGRAM = Program("antialias.cu", contract=False)
_THREADS = 256
_POINT = 3  # 64-bit words


class AntialiasCuda(torch.autograd.Function):
    """Shading and blending of what the z-buffer has found."""

    @staticmethod
    def forward(
        ctx: Any,
        vertices: Tensor,
        colors: Tensor,
        backgrounds: Tensor,
        per_face: bool,
        connectivity: "MeshConnectivity",
        view: tuple[Tensor, Tensor, float, int, int],
        seen: "HardRasterization",
    ) -> Tensor:
        """See ``rasterize_antialiased``; ``view`` has viewmats, Ks, near_plane, width, height."""
        vertices, colors, backgrounds = dense(vertices), dense(colors), dense(backgrounds)
        B, V, F = len(view[0]), len(vertices), len(connectivity.faces)
        ctx.per_face, ctx.connectivity, ctx.sizes = per_face, connectivity, view[2:]
        points = torch.empty((B, V, _POINT), dtype=torch.int64, device=vertices.device)
        silhouettes = torch.empty((B, F), dtype=torch.uint8, device=vertices.device)
        shaded = vertices.new_empty((B, view[4], view[3], colors.shape[1]))
        image = torch.empty_like(shaded)
        found = seen.triangle, seen.barycentrics, seen.depth
        tensors = vertices, colors, backgrounds, *view[:2], *found, points, silhouettes, shaded
        for b in range(B):
            scene = _scene(tensors, ctx, b)
            _run("antialias_points", V, (scene.view, points[b]))
            _run("antialias_silhouettes", F, (scene.view, points[b], silhouettes[b]))
            _run("antialias_shade", view[3] * view[4], (scene.view, shaded[b]))
            _run("antialias_blend", view[3] * view[4], (scene, shaded[b], image[b]))
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
        return (*grads, None, None, None, None)


def _struct(name: str) -> Any:
    return struct_class("cuda/antialias.cu", name)


def _run(name: str, count: int, arguments: tuple[Any, ...]) -> None:
    launch(_PROGRAM, name, blocks(count, _THREADS), _THREADS, arguments)


def _scene(tensors: tuple[Tensor, ...], ctx: Any, b: int) -> Any:
    """View b, as the kernels read it, where its arrays lie now."""
    vertices, colors, backgrounds, viewmats, Ks, triangle, barycentrics, depth, points, silhouettes, shaded = tensors
    connectivity, (near_plane, width, height) = ctx.connectivity, ctx.sizes
    floats = (vertices, viewmats[b], Ks[b], barycentrics[b], depth[b], colors, backgrounds[b])
    integers = (connectivity.faces, connectivity.pair_offsets, connectivity.paired_faces, triangle[b])
    view = _struct("AntialiasView")(
        *(tensor.data_ptr() for tensor in (*floats, *integers)),
        len(vertices),
        len(connectivity.faces),
        width,
        height,
        shaded.shape[-1],
        ctx.per_face,
        near_plane,
    )
    return _struct("Scene")(view, points[b].data_ptr(), silhouettes[b].data_ptr())
