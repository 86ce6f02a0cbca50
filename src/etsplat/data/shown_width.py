"""How much of the world a photo shows across: the measure of steps that look alike in every capture."""

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.data.dataset import Dataset, middles_of

_POINTS, _VIEWS = 10_000, 64
"""So many of the points are looked at at most, and in so many of the views."""


def shown_width(capture: Dataset, points: Float[Tensor, "P 3"]) -> float | None:
    """The longer side of what photos show at the points that are in them, in units of the capture's frame: the median.

    Args:
        capture: photos with cameras; those of its training views count.
        points: (P, 3) in its frame.

    Returns:
        None where no training view sees a point.
    """
    points = points.double()[:: max(1, len(points) // _POINTS)]
    widths = []
    for index in middles_of(capture.train, min(_VIEWS, len(capture.train))):
        (width, height), K, viewmat = capture.images.sizes[index], capture.Ks[index], capture.viewmats[index]
        camera = points @ viewmat[:3, :3].T + viewmat[:3, 3]
        camera = camera[camera[:, 2] > 0]
        pixel = camera @ K.T / camera[:, 2:]
        seen = ((pixel[:, :2] >= 0) & (pixel[:, :2] < torch.tensor([width, height]))).all(dim=1)
        widths.append(camera[seen, 2] * max(width, height) / K[0, 0])
    found = torch.cat([torch.empty(0, dtype=torch.float64), *widths])
    return float(found.median()) if len(found) else None
