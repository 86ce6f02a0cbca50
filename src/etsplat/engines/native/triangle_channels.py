"""Depths of centroids and normals by either native engine: one autograd function around its two calls."""

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from etsplat.engines.native.operation import differentiable
from etsplat.engines.native.pool import empty
from etsplat.engines.reference.channels import homogeneous_centroids

Call = Callable[..., None]


def triangle_channels(forward: Call, backward: Call) -> Callable[[Tensor, Tensor, bool, bool], Tensor]:
    """`Engine.triangle_channels` by an engine's calls.

    Args:
        forward: (corners, viewmats, depth, normals, channels), by name; the last is written.
        backward: (corners, viewmats, depth, normals, grad_channels, grad_corners), by name; the last is written.
    """
    return differentiable(partial(_forward, forward), partial(_backward, backward))


def _forward(
    call: Call, _keep: bool, corners: Tensor, viewmats: Tensor, depth: bool, normals: bool
) -> tuple[Tensor, Any]:
    channels = empty(corners, len(viewmats), len(corners), depth + 3 * normals)
    call(corners=corners, viewmats=viewmats, depth=depth, normals=normals, channels=channels)
    return channels, (corners, viewmats, depth, normals)


def _backward(call: Call, kept: Any, needed: Any, grad_channels: Tensor) -> tuple[Tensor, Tensor | None]:
    corners, viewmats, depth, normals = kept
    grad_corners = empty(corners, *corners.shape)
    call(
        corners=corners,
        viewmats=viewmats,
        depth=depth,
        normals=normals,
        grad_channels=grad_channels,
        grad_corners=grad_corners,
    )
    grad_viewmats = None
    if needed[1] and depth:
        finite = corners.isfinite().all(dim=2).all(dim=1)[:, None, None]
        grad_viewmats = torch.zeros_like(viewmats)
        grad_viewmats[:, 2] = grad_channels[..., 0] @ homogeneous_centroids(torch.where(finite, corners, 0.0))
    return grad_corners, grad_viewmats
