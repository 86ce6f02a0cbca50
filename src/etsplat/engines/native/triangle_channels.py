"""Depths of centroids and normals by either native engine: one autograd function around its two calls."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from etsplat.core.validation import dense
from etsplat.engines.native.pool import empty
from etsplat.engines.reference.triangle_channels import homogeneous_centroids

Run = Callable[[str, tuple[Any, ...], tuple[Tensor, ...]], None]
"""("forward" or "gradient", addresses of the inputs with their sizes and what is wanted, what it reads and writes)."""


def triangle_channels(run: Run, corners: Tensor, viewmats: Tensor, depth: bool, normals: bool) -> Tensor:
    """See `Engine.triangle_channels`."""
    channels: Any = _TriangleChannels.apply(corners, viewmats, depth, normals, run)
    return channels


class _TriangleChannels(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, corners: Tensor, viewmats: Tensor, depth: bool, normals: bool, run: Run) -> Tensor:
        corners, viewmats = dense(corners, "corners"), dense(viewmats, "viewmats")
        ctx.save_for_backward(corners, viewmats)
        ctx.settings = depth, normals, run
        channels = empty(corners, len(viewmats), len(corners), depth + 3 * normals)
        run("forward", _problem(corners, viewmats, depth, normals), (channels,))
        return channels

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_channels: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        corners, viewmats = map(dense, ctx.saved_tensors)
        depth, normals, run = ctx.settings
        grad_corners = empty(corners, *corners.shape)
        run("gradient", _problem(corners, viewmats, depth, normals), (dense(grad_channels), grad_corners))
        grad_viewmats = None
        if ctx.needs_input_grad[1] and depth:
            finite = corners.isfinite().all(dim=2).all(dim=1)[:, None, None]
            grad_viewmats = torch.zeros_like(viewmats)
            grad_viewmats[:, 2] = grad_channels[..., 0] @ homogeneous_centroids(torch.where(finite, corners, 0.0))
        return grad_corners, grad_viewmats, None, None, None


def _problem(corners: Tensor, viewmats: Tensor, depth: bool, normals: bool) -> tuple[Any, ...]:
    return corners.data_ptr(), viewmats.data_ptr(), len(corners), len(viewmats), depth, normals
