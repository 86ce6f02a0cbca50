"""How far a hollow goes: not on through what is too narrow to be looked into.

A foot on a stem is thicker than walls, too, and behind the bottom of a cup. Supposed to be hollow as the cup is, it
would be so where no photo sees it, and connected by a tube through the stem.
"""

import torch
from jaxtyping import Float
from scipy.ndimage import label
from scipy.spatial import KDTree
from torch import Tensor

from etsplat.data.visual_hull import Distance

_NODES = 2
"""Nodes of a grid along the width of a passage."""

_CORNERS = 1.0
"""What is at most so many widths farther from the middle of a wide place than its walls belongs to it: a corner of the
narrowest is sqrt(3) - 1 of them farther."""


def through_wide_passages(
    free: Distance, outside: Distance, opening: Float[Tensor, "P 3"], hull: Float[Tensor, "V 3"], width: float
) -> Distance:
    """What is free, as far as a ball of this radius comes from an opening; all of it where none fits into that.

    Args:
        free: of points, positive where they may be free, as far as they are from the rest.
        outside: of points, negative within the hull.
        opening: (P, 3) points all over it, no farther apart than passages are wide.
        hull: (V, 3) vertices of the hull.
        width: the radius.
    """
    step = width / _NODES
    axes = (torch.arange(float(low), float(high) + step, step) for low, high in zip(*hull.aminmax(dim=0), strict=True))
    nodes = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
    wide = outside(nodes.reshape(-1, 3)) < 0
    wide[wide.clone()] = free(nodes.reshape(-1, 3)[wide]) > width
    wide = wide.reshape(nodes.shape[:3])
    numbers = torch.zeros(wide.shape, dtype=torch.int32)
    label(wide.numpy(), output=numbers.numpy())
    number, places = numbers[wide], nodes[wide]
    if len(places) == 0:
        return free
    entered = number[torch.from_numpy(KDTree(opening.numpy()).query(places.numpy())[0]) <= 2 * step].unique()
    if len(entered) == 0:
        return free
    middles = places[torch.isin(number, entered)]
    reach, nearest = free(middles) + _CORNERS * width, KDTree(middles.numpy())

    def within_reach(points: Tensor) -> Tensor:
        away, which = (torch.from_numpy(found) for found in nearest.query(points.numpy()))
        return torch.minimum(free(points), reach[which] - away.to(points))

    return within_reach
