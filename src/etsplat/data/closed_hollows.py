"""Hollows of a mesh that a reconstruction has not: photos look deeper into the one than into the other.

Of plain objects no picture and no outline tells that, so it is asked of the input mesh itself; of photos, of a hull
that was cut open, over whose dark hollows a film may grow that has their colours.
"""

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn.functional import max_pool2d

from etsplat.data.dataset import Dataset
from etsplat.data.photos import first_hits, photos_of

_DEEPER = 0.2
"""So much deeper, in units of the ball around the object: grooves whose bottoms are rounded are less."""

Surface = tuple[Float[Tensor, "V 3"], Int64[Tensor, "F 3"]]


@torch.no_grad()
def closed_hollows(dataset: Dataset, truth: Surface, found: Surface) -> float:
    """Of the pixels at which training views see a mesh, the part where the result lies far in front of it.

    Args:
        dataset: photos of it in the unit ball.
        truth: the input mesh there, or what a run started from.
        found: the result.
    """
    closed, seen = 0, 0
    for photo in photos_of(dataset):
        wanted, depth = (first_hits(photo, *surface)[0] for surface in (truth, found))
        # Beside an outline a pixel may show what is before it or behind it.
        deepest = max_pool2d(depth[None, None], 3, stride=1, padding=1)[0, 0]
        closed += int(((wanted > 0) & (depth > 0) & (deepest < wanted - _DEEPER)).sum())
        seen += int((wanted > 0).sum())
    return closed / max(1, seen)
