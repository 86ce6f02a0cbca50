"""Opacities and softness of a soup as they are drawn, in plain PyTorch."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.core.rasterization import SOUP_SIGMA_FLOOR


def soup_activation(
    vertices: Tensor,
    opacity_logits: Tensor,
    sigma_raw: Tensor,
    limits: tuple[float, float] | Tensor,
    camera: Cameras | None,
    smallest: float,
    largest: float,
) -> tuple[Tensor, Tensor]:
    """See `etsplat.ops.soup_activation`."""
    floor, ceiling = limits
    opacities = floor + (1.0 - floor) * torch.sigmoid(opacity_logits)
    if camera is not None:
        opacities = torch.where(_left_out(vertices, camera, smallest, largest), 0.0, opacities)
    return opacities, (SOUP_SIGMA_FLOOR + torch.exp(sigma_raw)).clamp_max(ceiling)


def _left_out(vertices: Float[Tensor, "N 3 3"], camera: Cameras, smallest: float, largest: float) -> Bool[Tensor, " N"]:
    """Which triangles have a smaller inradius, 2 area / perimeter, or reach farther from their middle, projected."""
    rotation, translation = camera.viewmats[0, :3, :3], camera.viewmats[0, :3, 3]
    points = vertices @ rotation.T + translation
    pixels = points[..., :2] / points[..., 2:].clamp_min(1e-6) * torch.diagonal(camera.Ks[0])[:2]
    edges = pixels - pixels.roll(1, dims=1)
    doubled = (edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]).abs()
    reach = (pixels - pixels.mean(dim=1, keepdim=True)).norm(dim=-1).amax(dim=-1)
    return (doubled < smallest * edges.norm(dim=-1).sum(dim=-1)) | (reach > largest)
