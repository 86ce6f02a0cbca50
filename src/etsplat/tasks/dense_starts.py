"""Captures whose photos agree on more places than structure from motion kept, or of which nobody kept any."""

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.data.cubes import seen_sizes, thinned
from etsplat.data.dataset import Dataset
from etsplat.data.dense_cloud import COMPARED, FEWEST_POINTS, DenseStart, dense_start
from etsplat.data.plane_sweep import WIDEST, guessed_points, swept_points
from etsplat.optim.loop import Event, NoteEvent

LEAST_SHARE = 0.1
"""Photos that agree on a smaller part of their pixels do so by chance (0.01 of `lund`, and 0.4 to 0.6 of others)."""

POOR, DOUBTFUL = 0.3, 0.07
"""Of the places that a photo finds its neighbours find 0.44 to 0.84 where poses are right, 0.07 to 0.31 where cameras
are turned by a quarter of a degree (0.7 pixels of photos that are 200 wide), and 0.01 to 0.08 by a whole one. By poses
of the last kind more is learnt by heart than of the scene."""

COARSE = WIDEST // 2
"""Width of photos that are swept to learn how far away things are."""

OWN = 2 / 3
"""Part of the triangles at the start that begin at the capture's points, if it has so many: they are dense where there
is detail."""


def with_swept_points(
    capture: Dataset,
    most: int,
    device: torch.device,
    announce: Callable[[Event], None],
    progress: Callable[[int, int], None],
) -> tuple[Dataset, float]:
    """A capture that starts at what its training photos agree on, too, as evenly as photos show it.

    Structure from motion keeps corners and edges, many at one place and none at another. Triangles that begin at all of
    what photos show need not grow there from afar. Where points are many they are thinned to cubes that look about as
    large from the nearest camera, and what is swept takes the cubes in which there are none.

    Where there are no points, small photos are swept first, through all depths: these say between which the others are.

    Args:
        capture: in the frame that is trained in.
        most: triangles that there may be; there are half as many points then, or as many as the capture has, if more.
        device: where photos are compared.
        announce: told of what is found.
        progress: called with (photos compared, photos in all).

    Returns:
        That, and `Swept.consistent`, which says how good its poses are; NaN where that is not known.
    """
    points = capture.exact_points
    told = capture if points is not None else _with_coarse_points(capture, device)
    if told is None:
        announce(NoteEvent("start: photos agree on too little, so that triangles start at random places"))
        return capture, math.nan
    swept = swept_points(told, device, progress)
    agreed = f"photos agree on {100 * swept.share:.0f} % of their pixels"
    found = dense_start(swept.positions, swept.colors, capture, COMPARED) if swept.share >= LEAST_SHARE else None
    if found is None or not len(found.positions):
        elsewhere = "random places" if points is None else "the capture's points"
        announce(NoteEvent(f"start: {agreed} alone, so that triangles start at {elsewhere}"))
        return capture, swept.consistent
    start, taken = _of_places(capture, found, most) if points is None else _beside_points(capture, points, found, most)
    announce(NoteEvent(f"start: {agreed}; {taken}"))
    return start, swept.consistent


def _of_places(capture: Dataset, found: DenseStart, most: int) -> tuple[Dataset, str]:
    """A capture without points, with places that photos agree on; and what was done."""
    sizes = seen_sizes(found.positions, capture)
    positions, colors = thinned(found.positions, found.colors, max(1, most // 2), sizes)
    told = f"the capture has no points: {len(positions):,} of these places are the start"
    return replace(capture, exact_points=positions, point_colors=colors), told


def _beside_points(capture: Dataset, points: Float[Tensor, "P 3"], found: DenseStart, most: int) -> tuple[Dataset, str]:
    """A capture with such places beside its own points; and what was done."""
    colors = torch.full(points.shape, 0.5) if capture.point_colors is None else capture.point_colors
    count = max(most // 2, len(points))
    kept, kept_colors = thinned(points, colors, int(OWN * count), seen_sizes(points, capture))
    sizes, taken = seen_sizes(found.positions, capture), (kept, seen_sizes(kept, capture))
    added, added_colors = thinned(found.positions, found.colors, count - len(kept), sizes, taken)
    told = f"{len(added):,} of these places join {len(kept):,} of the capture's {len(points):,} points"
    assert kept_colors is not None
    assert added_colors is not None
    both = torch.cat([kept_colors, added_colors])
    return replace(capture, exact_points=torch.cat([kept, added]), point_colors=both), told


def _with_coarse_points(capture: Dataset, device: torch.device) -> Dataset | None:
    """A capture without points, with those that its photos agree on at half the size; None where these are few."""
    guessed = replace(capture, exact_points=guessed_points(capture), point_colors=None)
    swept = swept_points(guessed, device, widest=COARSE)
    if swept.share < LEAST_SHARE or len(swept.positions) < FEWEST_POINTS:
        return None
    return replace(capture, exact_points=swept.positions, point_colors=swept.colors)
