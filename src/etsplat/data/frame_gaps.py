"""Masks that end some pixels before the frame that cuts the object off, as some networks leave them.

There the object goes on, and whoever takes such a mask at its word learns that nothing is beyond the frame, in all of
space. So these pixels are cropped, where an outline runs along the frame over most of what is near to it; an object
that only comes near to it is round there, or loses some pixels of its background.
"""

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool

from etsplat.data.changed_pictures import Box, cropped
from etsplat.data.dataset import Dataset
from etsplat.data.silhouettes import silhouette

GAP = 0.01
"""Widest gap, as a fraction of the picture's longer side, rounded up."""

_DEEP = 3
"""An outline is near to the frame within so many times that."""

_ALONG = 0.8
"""And runs along it where so much of that is no farther off than a gap."""


def without_frame_gaps(dataset: Dataset) -> tuple[Dataset, list[int]]:
    """The photos without gaps between mask and frame, and which were cropped; nothing changes where there are none.

    Args:
        dataset: photos with alpha.
    """
    boxes = [_box(silhouette(photo)) for photo in dataset.images]
    gaps = [
        index
        for index, (box, (width, height)) in enumerate(zip(boxes, dataset.images.sizes, strict=True))
        if box != Box(0, 0, width, height)
    ]
    if not gaps:
        return dataset, []
    Ks = dataset.Ks.clone()
    Ks[:, :2, 2] -= torch.tensor([[box.left, box.upper] for box in boxes])
    return replace(dataset, Ks=Ks, images=cropped(dataset.images, boxes)), gaps


def _box(mask: Bool[np.ndarray, "H W"]) -> Box:
    """What is left of a photo without its gaps."""
    height, width = mask.shape
    gap = math.ceil(GAP * max(mask.shape))
    sides = (mask.T, mask, mask.T[::-1], mask[::-1])
    left, upper, right, lower = (gap if min(mask.shape) > 2 * gap and _is_gap(side, gap) else 0 for side in sides)
    return Box(left, upper, width - right, height - lower)


def _is_gap(mask: Bool[np.ndarray, "D L"], gap: int) -> bool:
    """Whether a silhouette ends along the first row of a picture, and before it."""
    near = mask[: _DEEP * (gap + 1)].any(axis=0)
    return bool(near.any()) and not mask[0].any() and mask[: gap + 1].any(axis=0).sum() >= _ALONG * near.sum()
