"""Depths and normals of triangles as channels, and their values at pixels, in plain PyTorch."""

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.engines.reference.rasterize import unit_normals


def triangle_channels(corners: Tensor, viewmats: Tensor, depth: bool, normals: bool) -> Tensor:
    """See `etsplat.ops.triangle_channels`."""
    finite = corners.isfinite().all(dim=2).all(dim=1)
    corners = torch.where(finite[:, None, None], corners, 0.0)
    viewmats = torch.where(viewmats.isfinite().all(dim=2).all(dim=1)[:, None, None], viewmats, 0.0)
    channels = []
    if depth:
        channels.append(homogeneous_centroids(corners) @ viewmats[:, 2, :, None])
    if normals:
        channels.append(_facing_normals(corners, viewmats))
    return torch.where(finite[:, None], torch.cat(channels, dim=-1), 0.0)


def homogeneous_centroids(corners: Float[Tensor, "N 3 3"]) -> Float[Tensor, "N 4"]:
    """With a fourth coordinate of 1."""
    centroids = (corners / 3).sum(dim=1)  # a sum before the division could be infinite, and 0 times it NaN
    return torch.nn.functional.pad(centroids, (0, 1), value=1.0)


def _facing_normals(corners: Float[Tensor, "N 3 3"], viewmats: Float[Tensor, "B 4 4"]) -> Float[Tensor, "B N 3"]:
    normal = unit_normals(corners)
    centers = -torch.einsum("bij,bi->bj", viewmats[:, :3, :3], viewmats[:, :3, 3])
    towards = corners.mean(1)[None] - centers[:, None]
    away = (towards * normal).sum(-1, keepdim=True) > 0
    return torch.where(away, -normal[None], normal[None])


def pick_values(values: Tensor, chosen: Tensor) -> Tensor:
    """See `etsplat.ops.pick_values`."""
    behind = torch.cat([values.new_zeros(len(values), 1), values], dim=1)
    return behind.gather(1, chosen.long().flatten(start_dim=1)).view(chosen.shape)
