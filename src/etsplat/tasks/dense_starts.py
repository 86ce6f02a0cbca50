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
    """A capture of few points with what its training photos agree on besides, as evenly as they may be.

    Structure from motion keeps corners and edges, many at one place and none at another. Triangles that begin at all of
    what photos show need not grow there from afar. Its points stay: they are dense where there is detail.

    Args:
        capture: in the frame that is trained in.
        most: triangles that there may be; there are half as many points then, if the capture has no more of its own.
        announce: told of what is found.
        progress: called with (photos compared, photos in all).
    """
    if capture.exact_points is None or (room := most // 2 - len(capture.exact_points)) <= 0:
        return capture
    swept = swept_points(capture, progress)
    agreed = f"photos agree on {100 * swept.share:.0f} % of their pixels"
    if swept.share < LEAST_SHARE:
        announce(NoteEvent(f"start: {agreed} alone, so that triangles start at the capture's points"))
        return capture
    found = dense_start(swept.positions, swept.colors, capture, room)
    joined = f"{len(found.positions):,} of these places join the capture's {len(capture.exact_points):,} points"
    announce(NoteEvent(f"start: {agreed}; {joined}"))
    positions, colors = torch.cat([capture.exact_points, found.positions]), None
    if capture.point_colors is not None:
        colors = torch.cat([capture.point_colors, found.colors])
    return replace(capture, exact_points=positions, point_colors=colors)
