"""How much of the world a photo shows across: the measure of steps that look alike in every capture, near and far."""

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.data.dataset import Dataset, middles_of

_POINTS = 10_000
"""So many of the points are looked at at most."""

_OFTEN = 24
"""Views that are asked, of many."""


def shown_width(capture: Dataset, points: Float[Tensor, "P 3"]) -> float | None:
    """The longer side of what photos show at the points that are in them, in units of the capture's frame: the median.

    Each point counts once: what is near is in many photos, and may be a small part of what is to be drawn.

    Args:
        capture: photos with cameras; those of its training views count.
        points: (P, 3) in its frame.

    Returns:
        None where no training view sees a point.
    """
    found = ShownWidths(capture)(points.double()[:: max(1, len(points) // _POINTS)])
    found = found[found.isfinite()]
    return float(found.median()) if len(found) else None


class ShownWidths:
    """The same at each of many points, for the whole of a run.

    All is done number by number, so that the bits do not depend on how many threads there are.
    """

    def __init__(self, capture: Dataset) -> None:
        """Takes the cameras.

        Args:
            capture: photos with cameras; some of its training views count, evenly spread.
        """
        views = middles_of(capture.train, min(_OFTEN, len(capture.train)))
        self._views = [(capture.viewmats[i].tolist(), capture.Ks[i].tolist(), capture.images.sizes[i]) for i in views]

    def __call__(self, points: Float[Tensor, "P 3"]) -> Float[Tensor, " P"]:
        """The longer side of what photos show at each point: the harmonic mean over those in which it lies.

        Returns:
            (P,) in units of the capture's frame; not finite for a point that is in none of the views looked at.
        """
        nearness, seen = (torch.zeros_like(points[:, 0]) for _ in range(2))
        x, y, z = points.unbind(dim=1)
        for viewmat, K, (width, height) in self._views:
            right, down, depth = (x * a + y * b + z * c + d for a, b, c, d in viewmat[:3])
            across, along = (right * a + down * b + depth * c for a, b, c in K[:2])
            inside = (depth > 0) & (across >= 0) & (across < width * depth) & (along >= 0) & (along < height * depth)
            nearness += torch.where(inside, K[0][0] / max(width, height) / depth, 0.0)
            seen += inside
        return seen / nearness
