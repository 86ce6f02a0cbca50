"""Keeping faces from cutting through others while vertices move: those that would make a new fold go back."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from etsplat.geometry.intersections import IntersectionSearch, intersecting_faces

_LOOKS = 20
"""Looks for intersections, after which all vertices go back."""


def around_folds(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Bool[Tensor, " F"]:
    """Faces that cut through others, and all that have a corner in common with one."""
    folded = torch.zeros(len(vertices), dtype=torch.bool)
    folded[faces[intersecting_faces(vertices, faces)].reshape(-1).long()] = True
    return folded[faces.long()].any(dim=1)


def held_back(
    moved: Float[Tensor, "V 3"],
    before: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    spared: Bool[Tensor, " F"],
) -> Float[Tensor, "V 3"]:
    """Moved vertices, of which the corners of faces that cut through others are back where they were before.

    Where that lets further faces cut through others, their corners go back too. With no face spared, none cuts through
    another in the result if none did before.

    Args:
        moved: (V, 3) finite, on the CPU.
        before: (V, 3).
        faces: (F, 3).
        spared: (F,) faces that may cut through others; what they alone cut through may not be put right.
    """
    found, back, search = moved.clone(), (moved == before).all(dim=1), IntersectionSearch(faces)
    for _ in range(_LOOKS):
        cutting = search(found) & ~spared
        corners = torch.zeros_like(back)
        corners[faces[cutting].reshape(-1).long()] = True
        if not bool((corners & ~back).any()):
            return found
        back |= corners
        found[corners] = before[corners]
    return before.clone()
