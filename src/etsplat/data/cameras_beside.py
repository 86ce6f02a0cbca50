"""Where else one would look at what photos show: between cameras, and beyond them."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from etsplat.core.cameras import camera_centers
from etsplat.data.camera_tour import apart, nearest_rotations

NEIGHBOURS = 3
"""Of each camera, on a way to or from which new ones stand."""

BEYOND = 1.0
"""So far beyond either of two cameras a new one may stand, as a part of the way between them."""

_TURNED = 0.5
"""Least cosine between where two neighbours look: there is nothing between cameras back to back."""


def cameras_beside(
    viewmats: Float[Tensor, "B 4 4"], count: int, generator: torch.Generator
) -> tuple[Float[Tensor, "N 4 4"], Int[Tensor, " N"]]:
    """Cameras on the lines through pairs of neighbours, evenly anywhere from beyond the one to beyond the other.

    Args:
        viewmats: world to camera.
        count: N at most; none where no two cameras are neighbours.
        generator: of the random choices, on the CPU.

    Returns:
        Their matrices, float64, and for each the index of the nearer camera of its pair.
    """
    if count < 1 or not len(pairs := _neighbours(viewmats)):
        return viewmats.new_zeros((0, 4, 4), dtype=torch.float64), torch.zeros(0, dtype=torch.int64)
    rounds = [torch.randperm(len(pairs), generator=generator) for _ in range(-(-count // len(pairs)))]
    first, second = pairs[torch.cat(rounds)[:count]].unbind(dim=1)
    along = (1 + 2 * BEYOND) * torch.rand(count, generator=generator, dtype=torch.float64) - BEYOND
    centers, rotations = camera_centers(viewmats.double()), viewmats[:, :3, :3].double()
    beside = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    turned = nearest_rotations(torch.lerp(rotations[first], rotations[second], along[:, None, None]))
    center = torch.lerp(centers[first], centers[second], along[:, None])
    beside[:, :3, :3] = turned
    beside[:, :3, 3] = -(turned @ center[..., None])[..., 0]
    return beside, torch.where(along < 0.5, first, second)


def _neighbours(viewmats: Float[Tensor, "B 4 4"]) -> Int[Tensor, "P 2"]:
    """Pairs of cameras of which one is among the nearest of the other, each pair once, in order."""
    axes = viewmats[:, 2, :3].double()
    distances = apart(viewmats).fill_diagonal_(torch.inf)
    distances = distances.masked_fill(axes @ axes.T < _TURNED, torch.inf)
    nearest = distances.argsort(dim=1, stable=True)[:, :NEIGHBOURS]
    own = torch.arange(len(viewmats))[:, None].expand_as(nearest)
    near = distances.gather(1, nearest).isfinite()
    pairs = torch.stack([own[near], nearest[near]], dim=1)
    return pairs.sort(dim=1).values.unique(dim=0)
