"""Photos made of other photos: parts of them, or smaller ones. They are made when they are needed, too."""

import hashlib
import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import torch

from etsplat.data.pictures import LazyPictures, Picture, Pictures, Pixels
from etsplat.io.depth_maps import resize_depth


class Box(NamedTuple):
    """A part of a picture: its first column and row, and those after its last."""

    left: int
    upper: int
    right: int
    lower: int


def cropped(pictures: Pictures, boxes: Sequence[Box]) -> LazyPictures:
    """Of each photo, its mask and its depths what is in a box."""
    sizes = [(box.right - box.left, box.lower - box.upper) for box in boxes]
    made, name = partial(_cropped, pictures, boxes), partial(_name_of_cropped, pictures, boxes)
    return LazyPictures(made, sizes, _bytes_of(pictures, sizes), name, with_depth=pictures.with_depth)


def halved(pictures: Pictures) -> LazyPictures:
    """Photos and masks at half the size, each pixel the mean of those it replaces; odd sizes are rounded down.

    Depths are not averaged (`resize_depth`).
    """
    sizes = [(max(1, width // 2), max(1, height // 2)) for width, height in pictures.sizes]
    made, in_bytes = partial(_halved, pictures, sizes), _bytes_of(pictures, sizes)
    return LazyPictures(made, sizes, in_bytes, pictures.fingerprint, with_depth=pictures.with_depth)


def _cropped(pictures: Pictures, boxes: Sequence[Box], index: int) -> Picture:
    picture, box = pictures.picture(index), boxes[index]
    rows, columns = slice(box.upper, box.lower), slice(box.left, box.right)
    mask = None if picture.mask is None else picture.mask[rows, columns].contiguous()
    depth = None if picture.depth is None else picture.depth[rows, columns].contiguous()
    return Picture(picture.pixels[rows, columns].contiguous(), mask, depth)


def _name_of_cropped(pictures: Pictures, boxes: Sequence[Box]) -> bytes:
    return hashlib.sha256(pictures.fingerprint() + repr(boxes).encode()).digest()


def _halved(pictures: Pictures, sizes: Sequence[tuple[int, int]], index: int) -> Picture:
    picture, (width, height) = pictures.picture(index), sizes[index]
    mask = None if picture.mask is None else _area_mean(picture.mask[..., None], width, height)[..., 0]
    depth = None if picture.depth is None else resize_depth(picture.depth, width, height)
    return Picture(_area_mean(picture.pixels, width, height), mask, depth)


def _bytes_of(pictures: Pictures, sizes: Sequence[tuple[int, int]]) -> list[int]:
    """What photos of other sizes take."""
    per_pixel = math.ceil(pictures.total_bytes / sum(width * height for width, height in pictures.sizes))
    return [per_pixel * width * height for width, height in sizes]


def _area_mean(image: Pixels, width: int, height: int) -> Pixels:
    planes = image.movedim(-1, 0)[None]
    mean = torch.nn.functional.interpolate(planes.float(), (height, width), mode="area")[0].movedim(0, -1)
    return ((mean + 0.5).to(torch.uint8) if image.dtype == torch.uint8 else mean).contiguous()
