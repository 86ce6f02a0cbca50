"""Whether a surface, seen from one side, goes around a place: as a handle around its hole."""

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from etsplat.geometry.topology import connected


def winds_around(places: Float[Tensor, "V 2"], edges: Int64[Tensor, "E 2"], place: Float[Tensor, "2"]) -> bool:
    """Whether some closed way along edges goes around a place that no face covers.

    Edges are cut where they cross a ray from the place. A way that goes around crosses it more often in one sense than
    in the other, so that the pieces that are left have no numbers which rise by one with each crossing.

    Args:
        places: (V, 2) of the vertices in the picture.
        edges: (E, 2) of a surface.
        place: in the same units.
    """
    ends = (places - place)[edges].double()
    (x, below), (other, above) = (end.unbind(dim=1) for end in ends.unbind(dim=1))
    crosses = (below < 0) != (above < 0)
    slope = (other - x)[crosses] / (above - below)[crosses]
    crosses[crosses.clone()] = (x[crosses] - below[crosses] * slope) > 0
    _, piece = connected(edges[~crosses], len(places))
    sense = torch.where(below[crosses] < 0, 1, -1)
    return not _rises(piece[edges[crosses]].tolist(), sense.tolist())


def _rises(links: list[list[int]], senses: list[int]) -> bool:
    """Whether pieces can be numbered so that each link leads up by its sense."""
    beside: dict[int, list[tuple[int, int]]] = {}
    for (tail, head), sense in zip(links, senses, strict=True):
        beside.setdefault(tail, []).append((head, sense))
        beside.setdefault(head, []).append((tail, -sense))
    number: dict[int, int] = {}
    for first in beside:
        number.setdefault(first, 0)
        going = [first]
        while going:
            piece = going.pop()
            for other, sense in beside[piece]:
                if other not in number:
                    number[other] = number[piece] + sense
                    going.append(other)
                elif number[other] != number[piece] + sense:
                    return False
    return True
