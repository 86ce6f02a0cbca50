"""How well what a photo shows matches its neighbours if it lies on a plane, for many planes: a pixel's best one.

That is the normalised cross-correlation of windows around a pixel, so exposure does not matter. On the CPU by native
code, which keeps no picture of what neighbours would show; elsewhere by torch, which is what that is tested against.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample

from etsplat import _native

WINDOW = 5
"""Side of the windows that are correlated, in pixels."""

AGREEING = 2
"""How many of the neighbours, the best ones, a plane is judged by: others may not see the place."""

BESIDE = 3
"""Planes that far from the best one are beside it."""

_LEAST_VARIANCE, _LEAST_DEPTH = 1e-6, 1e-6
"""What is divided by is no less: of grey values in a window, and of a place in front of a neighbour."""


class Neighbour(NamedTuple):
    """A photo to compare with.

    Attributes:
        grey: (h, w).
        rays: (3, 3) float64 from a place (x, y, 1) in the other photo, in pixels, to its ray to depth 1, as this one
            projects it.
        start: (3,) float64 where the other photo's rays begin, likewise.
    """

    grey: Float[Tensor, "h w"]
    rays: Float[Tensor, "3 3"]
    start: Float[Tensor, "3"]


class Matches(NamedTuple):
    """Of each pixel.

    Attributes:
        place: (H, W) the number of the best plane, with a fraction; -1 where that is the first or the last.
        best: (H, W) its correlation.
        elsewhere: (H, W) the best one of planes that are not beside it.
        contrast: (H, W) standard deviation of the photo in the window.
    """

    place: Float[Tensor, "H W"]
    best: Float[Tensor, "H W"]
    elsewhere: Float[Tensor, "H W"]
    contrast: Float[Tensor, "H W"]


def best_matches(grey: Float[Tensor, "H W"], neighbours: Sequence[Neighbour], inverse: Float[Tensor, " D"]) -> Matches:
    """The best plane of each pixel of a photo.

    Args:
        grey: in [0, 1].
        neighbours: `AGREEING` or more, on the same device.
        inverse: of each plane, 1 over its depth in the photo, evenly apart.
    """
    return _native_matches(grey, neighbours, inverse) if grey.is_cpu else matches_in_torch(grey, neighbours, inverse)


def _native_matches(grey: Tensor, neighbours: Sequence[Neighbour], inverse: Tensor) -> Matches:
    mean, variance = _spread(grey[None])
    place, best, elsewhere = (torch.empty_like(grey) for _ in range(3))
    _native.plane_sweep(
        grey=grey.contiguous(),
        mean=mean[0].contiguous(),
        variance=variance[0].contiguous(),
        neighbours=[each.grey.contiguous() for each in neighbours],
        rays=torch.stack([each.rays for each in neighbours]).float(),
        starts=torch.stack([each.start for each in neighbours]).float(),
        inverse=inverse,
        window=WINDOW,
        agreeing=AGREEING,
        beside=BESIDE,
        least_variance=_LEAST_VARIANCE,
        least_depth=_LEAST_DEPTH,
        place=place,
        best=best,
        elsewhere=elsewhere,
    )
    return Matches(place, best, elsewhere, variance[0].sqrt())


def matches_in_torch(
    grey: Float[Tensor, "H W"], neighbours: Sequence[Neighbour], inverse: Float[Tensor, " D"]
) -> Matches:
    """`best_matches` on any device, within rounding."""
    moments = _spread(grey[None])
    correlations = torch.stack([_correlation(grey, moments, neighbour, inverse) for neighbour in neighbours])
    judged = correlations.topk(AGREEING, dim=0).values.mean(dim=0)
    best, plane = judged.max(dim=0)
    number = torch.arange(len(inverse), device=grey.device)[:, None, None]
    elsewhere = judged.masked_fill((number - plane).abs() <= BESIDE, -1.0).amax(dim=0)
    within = plane.clamp(1, len(inverse) - 2)
    before, at, after = (judged.gather(0, (within + step)[None])[0] for step in (-1, 0, 1))
    between = ((before - after) / (2 * (before - 2 * at + after)).clamp_max(-1e-6)).clamp(-0.5, 0.5)
    place = torch.where(plane == within, plane + between, -1.0)
    return Matches(place, best, elsewhere, moments[1][0].sqrt())


def _correlation(
    grey: Tensor, moments: tuple[Tensor, Tensor], neighbour: Neighbour, inverse: Tensor
) -> Float[Tensor, "D H W"]:
    """Of the windows of a photo with those of another as each of the planes has it; -1 where that shows nothing."""
    h, w = neighbour.grey.shape
    row, column = (torch.arange(size, device=grey.device) + 0.5 for size in grey.shape)
    place = torch.stack(torch.broadcast_tensors(column[None, :], row[:, None], column.new_ones(())), dim=-1)
    along = (place.double() @ neighbour.rays.T).float()
    seen = along + neighbour.start.float() * inverse[:, None, None, None]
    size = torch.tensor([w, h], device=grey.device)
    places = 2 * seen[..., :2] / seen[..., 2:].clamp_min(_LEAST_DEPTH) / size - 1  # from -1 to 1 across the other
    outside = ~((places.abs() < 1).all(dim=-1) & (seen[..., 2] > 0))
    warped = grid_sample(neighbour.grey.expand(len(inverse), 1, -1, -1), places, align_corners=False)[:, 0]
    (mean, variance), (there, varies) = moments, _spread(warped)
    together = _windows(warped * grey) - mean * there
    return (together / (variance * varies).sqrt()).masked_fill(outside, -1.0)


def _spread(images: Float[Tensor, "D H W"]) -> tuple[Float[Tensor, "D H W"], Float[Tensor, "D H W"]]:
    """Mean and variance in the window around each pixel."""
    mean = _windows(images)
    return mean, (_windows(images.square()) - mean.square()).clamp_min(_LEAST_VARIANCE)


def _windows(images: Float[Tensor, "D H W"]) -> Float[Tensor, "D H W"]:
    """Means of the windows around each pixel, of what of them is in the image."""
    half = WINDOW // 2  # sums of shifted images take a seventh of the time of torch's pooling
    for axis in (-1, -2):
        size, sums = images.shape[axis], images.clone()
        for step in range(1, min(half, size - 1) + 1):
            left, right = (0, size - step), (step, size - step)
            sums.narrow(axis, *left).add_(images.narrow(axis, *right))
            sums.narrow(axis, *right).add_(images.narrow(axis, *left))
        place = torch.arange(size, device=images.device)
        counts = 1 + place.clamp_max(half) + (size - 1 - place).clamp_max(half)
        images = sums / counts.view(-1, *[1] * (-1 - axis))
    return images
