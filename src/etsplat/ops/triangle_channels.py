"""What depth and normal images are made of: the depth of each triangle's centroid, and its normal turned to the camera.

z = (R (v0 + v1 + v2) / 3 + t)_z      n = +- normalize((v1 - v0) x (v2 - v0)),  n . (centroid - camera) <= 0
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from etsplat import _native
from etsplat.core.validation import check_like, check_shape, dense
from etsplat.cuda.launch import blocks, launch
from etsplat.cuda.program import Program
from etsplat.cuda.structs import struct_class
from etsplat.ops._rasterize_reference import unit_normals
from etsplat.ops.engines import resolve_engine
from etsplat.ops.pool import empty_image

_PROGRAM = Program("triangle_channels.cu", contract=False)
_THREADS = 128


def triangle_channels(
    corners: Float[Tensor, "N 3 3"],
    viewmats: Float[Tensor, "B 4 4"],
    *,
    depth: bool,
    normals: bool,
    engine: str | None = None,
) -> Float[Tensor, "B N D"]:
    """Depths of centroids, then normals, those that are wanted; differentiable.

    Args:
        corners: (N, 3, 3) in world space. A triangle that is not finite gets zeros and no gradient.
        viewmats: (B, 4, 4) world to camera; one that is not finite counts as zeros.
        depth: whether the first channel is the view-space z of the centroid.
        normals: whether the last three are the unit normal in world space, 0 for a triangle without area.
        engine: "cpu", "cuda", "reference" or None (by dtype and device).

    Returns:
        (B, N, D), D from 1 to 4. Gradients reach corners, and through the depth viewmats.

    Raises:
        ValueError: Wrong shape, dtype or device, or nothing is wanted.
    """
    check_shape("corners", corners, ("N", 3, 3))
    check_shape("viewmats", viewmats, ("B", 4, 4))
    check_like("viewmats", viewmats, "corners", corners)
    if not (depth or normals):
        raise ValueError("depth and normals must not both be False")
    chosen = resolve_engine(engine, corners)
    if chosen != "reference":
        native: Any = _TriangleChannels.apply(corners, viewmats, depth, normals, chosen == "cuda")
        return native
    finite = corners.isfinite().all(dim=2).all(dim=1)
    corners = torch.where(finite[:, None, None], corners, 0.0)
    viewmats = torch.where(viewmats.isfinite().all(dim=2).all(dim=1)[:, None, None], viewmats, 0.0)
    channels = []
    if depth:
        channels.append(_homogeneous_centroids(corners) @ viewmats[:, 2, :, None])
    if normals:
        channels.append(_facing_normals(corners, viewmats))
    return torch.where(finite[:, None], torch.cat(channels, dim=-1), 0.0)


def _homogeneous_centroids(corners: Float[Tensor, "N 3 3"]) -> Float[Tensor, "N 4"]:
    centroids = (corners / 3).sum(dim=1)  # a sum before the division could be infinite, and 0 times it NaN
    return torch.nn.functional.pad(centroids, (0, 1), value=1.0)


def _facing_normals(corners: Float[Tensor, "N 3 3"], viewmats: Float[Tensor, "B 4 4"]) -> Float[Tensor, "B N 3"]:
    normal = unit_normals(corners)
    centers = -torch.einsum("bij,bi->bj", viewmats[:, :3, :3], viewmats[:, :3, 3])
    towards = corners.mean(1)[None] - centers[:, None]
    away = (towards * normal).sum(-1, keepdim=True) > 0
    return torch.where(away, -normal[None], normal[None])


class _TriangleChannels(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, corners: Tensor, viewmats: Tensor, depth: bool, normals: bool, on_device: bool) -> Tensor:
        inputs = dense(corners, "corners"), dense(viewmats, "viewmats")
        ctx.save_for_backward(*inputs)
        ctx.settings = depth, normals, on_device
        shape = len(viewmats), len(corners), depth + 3 * normals
        channels = corners.new_empty(shape) if on_device else empty_image(*shape)
        _run("forward", ctx.settings, inputs, (channels,))
        return channels

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_channels: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        corners, viewmats = map(dense, ctx.saved_tensors)
        depth, normals, on_device = ctx.settings
        grad_corners = torch.empty_like(corners) if on_device else empty_image(*corners.shape)
        _run("gradient", (depth, normals, on_device), (corners, viewmats), (dense(grad_channels), grad_corners))
        grad_viewmats = None
        if ctx.needs_input_grad[1] and depth:
            finite = corners.isfinite().all(dim=2).all(dim=1)[:, None, None]
            grad_viewmats = torch.zeros_like(viewmats)
            grad_viewmats[:, 2] = grad_channels[..., 0] @ _homogeneous_centroids(torch.where(finite, corners, 0.0))
        return grad_corners, grad_viewmats, None, None, None


def _run(
    name: str, settings: tuple[bool, bool, bool], inputs: tuple[Tensor, Tensor], outputs: tuple[Tensor, ...]
) -> None:
    depth, normals, on_device = settings
    addresses = [tensor.data_ptr() for tensor in inputs]
    problem = *addresses, len(inputs[0]), len(inputs[1]), depth, normals
    if on_device:
        grid = blocks(len(inputs[0]), _THREADS)
        struct = struct_class("cuda/triangle_channels.cu", "ChannelsOf")(*problem)
        launch(_PROGRAM, f"triangle_channels_{name}", grid, _THREADS, (struct, *outputs))
        return
    native = _native.triangle_channels if name == "forward" else _native.triangle_channels_backward
    native(*problem, *(tensor.data_ptr() for tensor in outputs))
