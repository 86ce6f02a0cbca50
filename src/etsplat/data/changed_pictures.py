"""Photos made of other photos: parts of them, smaller ones, or more. They are made when they are needed, too."""

import hashlib
import itertools
import math
from collections.abc import Iterable, Sequence
from functools import partial
from typing import NamedTuple

import torch

from etsplat.data.pictures import LazyPictures, Picture, Pictures, Pixels
from etsplat.io.depth_maps import resize_depth


class Joined(Pictures):
    """Photos of several data sets, in any order."""

    def __init__(self, parts: Sequence[Pictures], places: Sequence[tuple[int, int]] | None = None) -> None:
        """Takes all, which keep and let go of their photos themselves.

        Args:
            parts: what they are of.
            places: of each photo the index of its part, and its own in there; None for all, one part after the other.
        """
        everything = [(number, index) for number, part in enumerate(parts) for index in range(len(part))]
        self._parts, self._places = tuple(parts), everything if places is None else list(places)
        self.sizes = [self._parts[number].sizes[index] for number, index in self._places]
        self.total_bytes = sum(part.total_bytes for part in self._parts)
        self.streamed = any(part.streamed for part in self._parts)
        self.with_depth = frozenset(self._whose("with_depth"))
        self.straight = tuple(self._whose("straight"))

    def _whose(self, attribute: str) -> list[int]:
        """The photos whose parts name them."""
        named = [frozenset(getattr(part, attribute)) for part in self._parts]
        return [at for at, (number, index) in enumerate(self._places) if index in named[number]]

    def _of_part(self, number: int, indices: Iterable[int]) -> list[int]:
        """Those of these photos that are of a part, by their indices there."""
        return [index for part, index in (self._places[at] for at in indices) if part == number]

    @property
    def held_bytes(self) -> int:
        """Of all parts."""
        return sum(part.held_bytes for part in self._parts)

    def picture(self, index: int) -> Picture:
        """Of its part."""
        if not 0 <= index < len(self):
            raise IndexError(f"view {index}: expected one in [0, {len(self)})")
        number, place = self._places[index]
        return self._parts[number].picture(place)

    def fingerprint(self) -> bytes:
        """Of all parts and of the order."""
        digest = hashlib.sha256(repr(self._places).encode())
        for part in self._parts:
            digest.update(part.fingerprint())
        return digest.digest()

    def subset(self, indices: Sequence[int]) -> "Joined":
        """Of subsets of the parts."""
        parts = [part.subset(self._of_part(number, indices)) for number, part in enumerate(self._parts)]
        counts = [itertools.count() for _ in parts]
        owners = [self._places[index][0] for index in indices]
        return Joined(parts, [(owner, next(counts[owner])) for owner in owners])

    def expect(self, indices: Sequence[int]) -> None:
        """Of their parts."""
        for number, part in enumerate(self._parts):
            part.expect(self._of_part(number, indices))


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
