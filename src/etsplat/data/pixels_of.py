"""At which pixels photos show points, of all photos at once: a product each, and a look-up each, are slow."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from etsplat.data.agreement import Photo


class PixelsOf:
    """The pixels of photos, numbered one photo behind another."""

    def __init__(self, photos: Sequence[Photo]) -> None:
        self._rotations = torch.cat([photo.viewmat[:3, :3] for photo in photos])
        self._offsets = torch.cat([photo.viewmat[:3, 3:] for photo in photos])
        self._Ks = torch.stack([photo.K for photo in photos])[..., None]
        heights, widths = torch.tensor([photo.pixels.shape[2:] for photo in photos]).T[..., None]
        self._heights, self._widths = heights, widths
        sizes = heights * widths
        self._first, self._none = sizes.cumsum(0) - sizes, int(sizes.sum())

    def show(self, points: Float[Tensor, "N 3"]) -> tuple[Int64[Tensor, "B N"], Float[Tensor, "B N"]]:
        """The number of the pixel at which each photo shows each point, and its depth; of none beside the photo."""
        # Each coordinate in a row of memory: products of (N, 3) with a matrix take ten times as long.
        x, y, z = (self._rotations @ points.T.contiguous() + self._offsets).view(-1, 3, len(points)).unbind(1)
        per_depth = 1 / torch.where(z > 0, z, torch.nan)
        column, row = ((K[:, 0] * x + K[:, 1] * y + K[:, 2] * z) * per_depth for K in self._Ks[:, :2].unbind(1))
        shown = (column >= 0) & (column < self._widths) & (row >= 0) & (row < self._heights)
        number = self._first + row.nan_to_num().long() * self._widths + column.nan_to_num().long()
        return torch.where(shown, number, self._none), z

    def together(self, maps: Sequence[Tensor]) -> Tensor:
        """What (H, W) maps of the photos have at each pixel, by its number; 0 where there is none."""
        return torch.cat([*(each.flatten() for each in maps), maps[0].new_zeros(1)])
