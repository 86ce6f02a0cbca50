"""Captures whose photos agree on more places than structure from motion kept."""

from collections.abc import Callable
from dataclasses import replace

import torch

from etsplat.data.dataset import Dataset
from etsplat.data.dense_cloud import dense_start
from etsplat.data.plane_sweep import swept_points
from etsplat.optim.loop import Event, NoteEvent

LEAST_SHARE = 0.1
"""Photos that agree on a smaller part of their pixels do so by chance (0.01 of `lund`, and 0.4 to 0.6 of others)."""


def with_swept_points(
    capture: Dataset, most: int, announce: Callable[[Event], None], progress: Callable[[int, int], None]
) -> Dataset:
    """A capture with what its training photos agree on beside its points, as evenly as they may be.

    Structure from motion keeps corners and edges, many at one place and none at another. Triangles that begin at all of
    what photos show need not grow there from afar.

    Args:
        capture: in the frame that is trained in.
        most: triangles that there may be; half as many points are taken, or as many as the capture has of its own.
        announce: told of what is found.
        progress: called with (photos compared, photos in all).
    """
    if capture.exact_points is None:
        return capture
    swept = swept_points(capture, progress)
    agreed = f"photos agree on {100 * swept.share:.0f} % of their pixels"
    if swept.share < LEAST_SHARE:
        announce(NoteEvent(f"start: {agreed} alone, so that triangles start at the capture's points"))
        return capture
    positions = torch.cat([capture.exact_points, swept.positions])
    own = capture.point_colors
    colors = None if own is None else torch.cat([own, swept.colors])
    found = dense_start(positions, colors, capture, max(1, most // 2, len(capture.exact_points)))
    announce(NoteEvent(f"start: {agreed}; {found.note}"))
    return replace(capture, exact_points=found.positions, point_colors=found.colors)
