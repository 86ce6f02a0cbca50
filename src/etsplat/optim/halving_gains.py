"""Which faces the photos agree to halve: how much better colours of their halves explain photos that they do not know.

The photos are dealt into parts. Of each face, what its pictures lack is explained by a correction that is linear over
the face, and by one for each of its halves, both fitted to all parts but one and tried on that one. More triangles than
pixels carry learn photos by heart: there the halves are worse on the photos that they do not know, and the face stays
whole.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from etsplat import _native
from etsplat.core.validation import dense

_PARTS = 4
"""Of the photos, each left out once."""

_RIDGE = 1.0
"""Corrections keep to none, and those of halves to that of the whole, as if so many pixels at each corner said so."""

_SQUARE = (0, 1, 2, 1, 3, 4, 2, 4, 5)
"""Where each of the nine products of barycentrics is among the six that are kept."""

_PRODUCTS = 6

_SIZES = (0, 3, 5)
"""Which of them are squares, above 0 where there is a pixel."""

_TOGETHER = 1 << 12


class HalvingGains:
    """Sums over the pixels of each part of the photos, of each half of a face: normal equations of its correction."""

    def __init__(self, corners: Float[Tensor, "F 3 3"]) -> None:
        """Has seen nothing yet.

        Args:
            corners: of the faces, which are halved at the middles of their longest edges (`optim.edit.halves_plan`).
        """
        self._count = len(corners)
        corners = corners.detach().cpu()
        self._longest = (corners.roll(-1, dims=1) - corners).norm(dim=2).argmax(dim=1)
        self._sums = torch.zeros(_PARTS, self._count, 2, _PRODUCTS + 9)

    def add(
        self,
        photo: int,
        face: Int[Tensor, " P"],
        barycentrics: Float[Tensor, "P 3"],
        lacking: Float[Tensor, "P 3"],
        counted: Float[Tensor, " P"],
    ) -> None:
        """Takes in the pixels of a picture, on the CPU.

        Args:
            photo: its number, by which it belongs to a part.
            face: the nearest, -1 where there is none.
            barycentrics: of the pixel's middle in it.
            lacking: photo minus picture.
            counted: how much a pixel counts, from 0 to 1.
        """
        pixels = {"face": face, "barycentrics": barycentrics, "lacking": lacking, "counted": counted}
        given = {name: dense(values) for name, values in pixels.items()}
        _native.add_halving_sums(**given, longest=self._longest, sums=self._sums[photo % _PARTS])

    def gains(self) -> Float[Tensor, " F"]:
        """By how much less the sum of squared differences of photos left out is for the halves, float64."""
        in_parts = (self._sums[..., _SIZES].sum(dim=(2, 3)) > 0).sum(dim=0)
        asked = (in_parts > 1).nonzero()[:, 0]  # what a single part shows, nobody else says anything of
        gained = torch.zeros(self._count, dtype=torch.float64)
        gained[asked] = torch.cat([_gains(self._sums[:, some].double()) for some in asked.split(_TOGETHER)])
        return gained


def _gains(sums: Float[Tensor, "R F 2 15"]) -> Float[Tensor, " F"]:
    squares = sums[..., _SQUARE].unflatten(-1, (3, 3))
    pulls = sums[..., _PRODUCTS:].unflatten(-1, (3, 3))
    ridge = _RIDGE * torch.eye(3, dtype=sums.dtype)
    known_squares, known_pulls = squares.sum(dim=0) - squares, pulls.sum(dim=0) - pulls
    whole = torch.linalg.solve(known_squares.sum(dim=2) + ridge, known_pulls.sum(dim=2))[:, :, None]
    halves = whole + torch.linalg.solve(known_squares + ridge, known_pulls - known_squares @ whole)
    gained = _square_sums(whole, squares, pulls) - _square_sums(halves, squares, pulls)
    return gained.sum(dim=(0, 2))


def _square_sums(
    corrections: Float[Tensor, "R F #2 3 3"], squares: Float[Tensor, "R F 2 3 3"], pulls: Float[Tensor, "R F 2 3 3"]
) -> Float[Tensor, "R F 2"]:
    """Of what corrections leave, but for a part that is the same for all of them."""
    return (corrections * (squares @ corrections - 2 * pulls)).sum(dim=(-1, -2))
