"""Points of structure from motion that hang before everything else: no start for a triangle.

A triangle that begins just before a camera grows to a veil over the whole photo. It takes what light differs from photo
to photo, and hangs over the views that no photo tells it of.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.data.dataset import Dataset
from etsplat.data.dense_cloud import seen_in_other_colors
from etsplat.data.depth_points import framed, project

BEGINS_WITH = 0.01
"""What a capture shows begins where this part of its points is nearer to the nearest photo."""


def without_strays(capture: Dataset, nearest: float) -> Dataset:
    """A capture without the points that hang before it and that photos see in different colours; a note says how many.

    Args:
        capture: photos and points.
        nearest: how near points may be to the nearest training photo that they are in, as a part of where the capture
            begins; nearer ones are asked for their colours. 0 leaves all.
    """
    points, colors = capture.exact_points, capture.point_colors
    if points is None or nearest == 0:
        return capture
    depth = _nearest_depth(capture, points)
    begins = depth.sort().values[int(BEGINS_WITH * int(depth.isfinite().sum()))]
    asked = (depth < nearest * begins).nonzero()[:, 0]
    stray = asked[seen_in_other_colors(points[asked], None if colors is None else colors[asked], capture)]
    if not len(stray):
        return capture
    kept = torch.ones(len(points), dtype=torch.bool)
    kept[stray] = False
    note = f"start: {len(stray):,} points hang before all others in no colour that photos agree on; without them"
    return replace(
        capture,
        exact_points=points[kept],
        point_colors=None if colors is None else colors[kept],
        notes=(*capture.notes, note),
    )


def _nearest_depth(capture: Dataset, points: Float[Tensor, "P 3"]) -> Float[Tensor, " P"]:
    """In front of the nearest training photo that shows each point; inf where none does."""
    nearest = torch.full((len(points),), torch.inf, dtype=points.dtype)
    for view in capture.train:
        depth, column, row = project(capture, view, points)
        inside = framed(capture, view, depth, column, row)
        nearest = torch.where(inside, torch.minimum(nearest, depth), nearest)
    return nearest
