"""Photos in which the object is small, cropped to it, so that what goes by the size of photos goes by the object's."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool

from etsplat.data.changed_pictures import Box, cropped
from etsplat.data.dataset import Dataset
from etsplat.data.frame_gaps import GAP
from etsplat.data.silhouettes import silhouette

_SMALL = 0.5
"""Fraction of a photo's longer side below which the object is small in it."""

_ROOM = 0.15
"""What is left around it on each side, as a fraction of its longer side; half of that where it is unusually large."""

_MOST = 0.9
"""So large a part of the training photos has it no larger than its size is said to be: masks of some have blobs."""


class _Extent(NamedTuple):
    """Where a mask shows the object.

    Attributes:
        box: around all of it.
        whole: whether it keeps off the frame, by more than the gap that masks may leave there.
        share: its longer side, as a fraction of the photo's.
    """

    box: Box
    whole: bool
    share: float


def object_side(dataset: Dataset) -> float:
    """How many pixels the object is long in the training photos: in nearly all of them no more than that."""
    return _usual([_longer(_extent(silhouette(dataset.images[index])).box) for index in dataset.train])


def close_ups(dataset: Dataset) -> list[Box] | None:
    """What to crop photos to, where the object is small in most of them; None where it is not.

    Photos whose mask comes near to the frame stay whole: what is beyond the object there says that nothing is.

    Args:
        dataset: photos with alpha.
    """
    extents = [_extent(silhouette(photo)) for photo in dataset.images]
    share = _usual([extents[index].share for index in dataset.train])
    if not 0 < share < _SMALL:
        return None
    return [_around(extent, share, size) for extent, size in zip(extents, dataset.images.sizes, strict=True)]


def cropped_to(dataset: Dataset, boxes: Sequence[Box], sizes: Sequence[tuple[int, int]]) -> Dataset:
    """Photos cropped to boxes, which are given in those of other sizes.

    Args:
        dataset: the photos.
        boxes: of each.
        sizes: (width, height) of each that its box is of.
    """
    scaled = [_scaled(*each) for each in zip(boxes, sizes, dataset.images.sizes, strict=True)]
    Ks = dataset.Ks.clone()
    Ks[:, :2, 2] -= torch.tensor([[box.left, box.upper] for box in scaled])
    return replace(dataset, Ks=Ks, images=cropped(dataset.images, scaled))


def _usual(numbers: Sequence[float]) -> float:
    return float(np.quantile(numbers, _MOST)) if numbers else 0.0


def _extent(mask: Bool[np.ndarray, "H W"]) -> _Extent:
    height, width = mask.shape
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    if len(rows) == 0:
        return _Extent(Box(0, 0, 0, 0), True, 0.0)
    box = Box(int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1)
    nearest = min(box.left, box.upper, width - box.right, height - box.lower)
    longer = max(width, height)
    return _Extent(box, nearest > GAP * longer + 1, _longer(box) / longer)


def _longer(box: Box) -> int:
    return max(box.right - box.left, box.lower - box.upper)


def _around(extent: _Extent, share: float, size: tuple[int, int]) -> Box:
    """Around the object, as large as around the usual one, so that photos of one size stay that."""
    if not extent.whole:
        return Box(0, 0, *size)
    side = round(max((1 + 2 * _ROOM) * share, (1 + _ROOM) * extent.share) * max(size))
    sides = [min(side, length) for length in size]
    middles = ((extent.box.left + extent.box.right) // 2, (extent.box.upper + extent.box.lower) // 2)
    return _placed([middle - side // 2 for middle, side in zip(middles, sides, strict=True)], sides, size)


def _scaled(box: Box, size: tuple[int, int], other: tuple[int, int]) -> Box:
    """A box of a photo in the same photo of another size."""
    across, down = other[0] / size[0], other[1] / size[1]
    sides = [max(1, round((box.right - box.left) * across)), max(1, round((box.lower - box.upper) * down))]
    return _placed([round(box.left * across), round(box.upper * down)], sides, other)


def _placed(corner: Sequence[int], sides: Sequence[int], size: tuple[int, int]) -> Box:
    """So large a box, where it was to begin or as near to that as the photo holds it."""
    left, upper = (max(0, min(at, length - side)) for at, side, length in zip(corner, sides, size, strict=True))
    return Box(left, upper, left + sides[0], upper + sides[1])
