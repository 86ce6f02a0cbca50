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

_SUMS = 15
"""Six products of barycentrics, nine of these and what a pixel lacks (csrc/cpu/halving_sums.h)."""


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
        self._sums = torch.zeros(_PARTS, self._count, 2, _SUMS)

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
        gained = torch.empty(self._count, dtype=torch.float64)
        _native.halving_gains(sums=self._sums, gains=gained)
        return gained
