"""Depths of centroids and normals by either native engine: one autograd function around its two calls."""

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from etsplat.engines.native.operation import differentiable
from etsplat.engines.native.pool import empty
from etsplat.engines.reference.triangle_channels import homogeneous_centroids

Run = Callable[[str, tuple[Any, ...], tuple[Tensor, ...]], None]
"""("forward" or "gradient", addresses of the inputs with their sizes and what is wanted, what it reads and writes)."""


def triangle_channels(run: Run) -> Callable[[Tensor, Tensor, bool, bool], Tensor]:
    """`Engine.triangle_channels` by an engine's calls."""
    return differentiable(partial(_forward, run), partial(_backward, run))


def _forward(
    run: Run, _keep: bool, corners: Tensor, viewmats: Tensor, depth: bool, normals: bool
) -> tuple[Tensor, Any]:
    channels = empty(corners, len(viewmats), len(corners), depth + 3 * normals)
    run("forward", _problem(corners, viewmats, depth, normals), (channels,))
    return channels, (corners, viewmats, depth, normals)


def _backward(run: Run, kept: Any, needed: Any, grad_channels: Tensor) -> tuple[Tensor, Tensor | None]:
    corners, viewmats, depth, _ = kept
    grad_corners = empty(corners, *corners.shape)
    run("gradient", _problem(*kept), (grad_channels, grad_corners))
    grad_viewmats = None
    if needed[1] and depth:
        finite = corners.isfinite().all(dim=2).all(dim=1)[:, None, None]
        grad_viewmats = torch.zeros_like(viewmats)
        grad_viewmats[:, 2] = grad_channels[..., 0] @ homogeneous_centroids(torch.where(finite, corners, 0.0))
    return grad_corners, grad_viewmats


def _problem(corners: Tensor, viewmats: Tensor, depth: bool, normals: bool) -> tuple[Any, ...]:
    return corners.data_ptr(), viewmats.data_ptr(), len(corners), len(viewmats), depth, normals
