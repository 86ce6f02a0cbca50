"""Regions of space that a scene is cropped to, and how they are written in words."""

import math
from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from etsplat.core.errors import InputError

FORMS = "sphere:X,Y,Z,R or box:X0,Y0,Z0,X1,Y1,Z1"
"""How a region is written: a ball by its middle and radius, a box by two opposite corners."""


@dataclass(frozen=True)
class Sphere:
    """A ball.

    Attributes:
        middle: its centre.
        radius: finite, > 0, in the units of the middle.
    """

    middle: tuple[float, float, float]
    radius: float

    def __str__(self) -> str:
        return "sphere:" + ",".join(f"{number:.9g}" for number in (*self.middle, self.radius))

    def holds(self, points: Float[Tensor, "N 3"]) -> Bool[Tensor, " N"]:
        """Which points are inside or on the border."""
        points = points.double()
        return (points - points.new_tensor(self.middle)).norm(dim=1) <= self.radius


@dataclass(frozen=True)
class Box:
    """A box along the axes.

    Attributes:
        low: the least coordinates.
        high: the greatest ones, each above that of `low`.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def __str__(self) -> str:
        return "box:" + ",".join(f"{number:.9g}" for number in (*self.low, *self.high))

    def holds(self, points: Float[Tensor, "N 3"]) -> Bool[Tensor, " N"]:
        """Which points are inside or on the border."""
        points = points.double()
        return ((points >= points.new_tensor(self.low)) & (points <= points.new_tensor(self.high))).all(dim=1)


Region = Sphere | Box


def region_of(text: str, name: str = "crop") -> Region:
    """The region that a text such as "sphere:0,0,1,2.5" stands for. Corners of a box may come in any order.

    Args:
        text: as `FORMS` says.
        name: of the argument, for errors.

    Raises:
        InputError: it stands for none, or for one without an inside.
    """
    kind, _, listed = text.partition(":")
    count = {"sphere": 4, "box": 6}.get(kind)
    try:
        numbers = [float(word) for word in listed.split(",")]
    except ValueError:
        numbers = []
    if count is None or len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise InputError(f"{name}: is {text!r}; write auto, {FORMS}, with finite numbers and no spaces")
    if kind == "sphere":
        if numbers[3] <= 0:
            raise InputError(f"{name}: is {text!r}, a sphere of radius {numbers[3]:g}; the radius must be above 0")
        return Sphere((numbers[0], numbers[1], numbers[2]), numbers[3])
    (x0, x1), (y0, y1), (z0, z1) = (sorted(pair) for pair in zip(numbers[:3], numbers[3:], strict=True))
    if x0 == x1 or y0 == y1 or z0 == z1:
        raise InputError(f"{name}: is {text!r}, a box without an inside; its corners must differ along every axis")
    return Box((x0, y0, z0), (x1, y1, z1))
