"""Points of a dense cloud that photos speak for: a start for triangles, thinned to a number that can be carried.

A point counts as seen in a photo if no other of the cloud hides it there. It stays if enough photos see it, most of
these in its colour, and if photos with transparency do not show what is behind it instead.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from etsplat.data.cubes import thinned
from etsplat.data.dataset import Dataset
from etsplat.data.depth_points import framed, project
from etsplat.data.pictures import as_float, unpremultiplied

SEEN_BY, AGREEING = 2, 0.5
"""So many photos must see a point, and this part of them in its colour."""

COLOR_APART = 0.12
"""Mean difference of the three channels, up to which colours agree: light and exposure differ a little."""

OUTSIDE = 0.1
"""Part of the photos with the point in their frame that may show that nothing is there."""

COLOR_SPREAD, ROUNDS = 0.1, 2
"""Standard deviation of a point's colour over the photos, mean of the channels, up to which it is one place; and how
often photos are asked, the second time with points hidden only by those that stayed."""

CELLS, IN_CELL, BEHIND = 96, 8, 1.02
"""A point is hidden behind others in the same field that are nearer by this factor; there are so many fields along the
width, or fewer, so that points are as many in each."""

FEWEST_POINTS = 100
"""What photos speak for is no start where there are fewer."""

COMPARED = 1_000_000
"""Larger clouds are thinned to so many points before they are compared with the photos. Fewer would hide too little."""


@dataclass(frozen=True)
class DenseStart:
    """What is left of a cloud.

    Attributes:
        positions: (P, 3) float64.
        colors: (P, 3) float32 in [0, 1] as displayed.
        note: how many there were, and why others were left out.
    """

    positions: Float[Tensor, "P 3"]
    colors: Float[Tensor, "P 3"]
    note: str


_FEW, _EMPTY, _COLOR = "are seen by too few photos", "are where photos show nothing", "look different in every photo"


@dataclass(frozen=True)
class _Seen:
    """Of every point, in one photo: whether it is in the frame, whether nothing is there, its colour where seen."""

    framed: Bool[Tensor, " P"]
    outside: Bool[Tensor, " P"]
    seen: Bool[Tensor, " P"]
    colors: Float[Tensor, "P 3"]


@dataclass
class _Votes:
    """What the photos so far say of every point.

    Attributes:
        framed: how many have it in their frame.
        empty: how many of them show that nothing is there.
        seen: how many see it.
        sums: of the colours that they see, and of their squares.
        apart: how many see it in another colour than its own.
    """

    framed: Float[Tensor, " P"]
    empty: Float[Tensor, " P"]
    seen: Float[Tensor, " P"]
    apart: Float[Tensor, " P"]
    sums: Float[Tensor, "2 P 3"]

    @classmethod
    def nothing(cls, count: int) -> "_Votes":
        framed, empty, seen, apart = torch.zeros((4, count)).unbind()
        return cls(framed, empty, seen, apart, torch.zeros((2, count, 3)))

    def add(self, look: _Seen, colors: Float[Tensor, "P 3"] | None) -> None:
        self.framed += look.framed
        self.empty += look.outside
        self.seen += look.seen
        shown = torch.where(look.seen[:, None], look.colors, 0.0)
        self.sums += torch.stack([shown, shown.square()])
        if colors is not None:
            self.apart += look.seen & ((look.colors - colors).abs().mean(dim=1) > COLOR_APART)

    def mean_color(self) -> Float[Tensor, "P 3"]:
        return self.sums[0] / self.seen.clamp_min(1)[:, None]

    def against(self, needed: int) -> dict[str, Bool[Tensor, " P"]]:
        """Which points are to go, by why."""
        spread = (self.sums[1] / self.seen.clamp_min(1)[:, None] - self.mean_color().square()).clamp_min(0).sqrt()
        differs = (spread.mean(dim=1) > COLOR_SPREAD) | (self.apart > (1 - AGREEING) * self.seen)
        return {_EMPTY: self.empty > OUTSIDE * self.framed, _FEW: self.seen < needed, _COLOR: differs}


def dense_start(
    points: Float[Tensor, "P 3"],
    colors: Float[Tensor, "P 3"] | None,
    dataset: Dataset,
    most: int,
    progress: Callable[[int, int], None] | None = None,
) -> DenseStart:
    """The points of a cloud that the training photos speak for.

    Args:
        points: (P, 3) float64, in the frame of the data set.
        colors: (P, 3) in [0, 1]; None to take those of the photos.
        dataset: photos.
        most: so many points at most.
        progress: called with (photos compared, photos in all).
    """
    total = len(points)
    points, colors = thinned(points, colors, max(COMPARED, most))
    hiding, done = torch.ones(len(points), dtype=torch.bool), 0
    votes, reasons = _Votes.nothing(0), {}
    for _ in range(ROUNDS):  # what turned out to be nowhere hides nothing from then on
        votes = _Votes.nothing(len(points))
        for view in dataset.train:
            votes.add(_look(dataset, view, points, hiding), colors)
            done += 1
            if progress is not None:
                progress(done, ROUNDS * len(dataset.train))
        reasons = votes.against(min(SEEN_BY, len(dataset.train)))
        hiding = ~(reasons[_EMPTY] | reasons[_COLOR])
    left, told = torch.ones(len(points), dtype=torch.bool), []
    for reason, wrong in reasons.items():
        count = int((left & wrong).sum())
        told += [f"{100 * count / len(points):.1f} % {reason}"] if count else []
        left &= ~wrong
    shown = votes.mean_color() if colors is None else colors
    kept, shown = thinned(points[left], shown[left], most)
    assert shown is not None
    why = f"; {', '.join(told)}" if told else ""
    return DenseStart(kept, shown, f"starting from {len(kept):,} of {total:,} points{why}")


def seen_in_other_colors(
    points: Float[Tensor, "P 3"], colors: Float[Tensor, "P 3"] | None, dataset: Dataset
) -> Bool[Tensor, " P"]:
    """Which points training photos see in different colours, so that nothing is there. None of them hides others.

    Args:
        points: (P, 3) float64, in the frame of the data set.
        colors: (P, 3) in [0, 1] of the points themselves, if they have any.
        dataset: photos.
    """
    votes, hiding = _Votes.nothing(len(points)), torch.zeros(len(points), dtype=torch.bool)
    for view in dataset.train:
        if bool(framed(dataset, view, *project(dataset, view, points)).any()):
            votes.add(_look(dataset, view, points, hiding), colors)
    return votes.against(SEEN_BY)[_COLOR]


def _look(dataset: Dataset, view: int, points: Float[Tensor, "P 3"], hiding: Bool[Tensor, " P"]) -> _Seen:
    """What a photo says of every point, where those that are `hiding` hide others."""
    picture, (width, _) = dataset.images.picture(view), dataset.images.sizes[view]
    depth, column, row = project(dataset, view, points)
    inside = framed(dataset, view, depth, column, row)
    column = torch.where(inside, column, 0).long()
    row = torch.where(inside, row, 0).long()
    cells = min(CELLS, max(1, int((int((inside & hiding).sum()) / IN_CELL) ** 0.5)))
    cell = (row * cells // width) * cells + column * cells // width
    nearest = torch.full((int(cell.max()) + 1,), torch.inf, dtype=depth.dtype)
    nearest = nearest.scatter_reduce(0, cell[inside & hiding], depth[inside & hiding], "amin")
    colors, opaque = unpremultiplied(as_float(picture.pixels)[row, column])
    if picture.mask is not None:
        inside = inside & (picture.mask[row, column] > 127)
    seen = inside & opaque & (depth <= BEHIND * nearest[cell])
    return _Seen(inside, inside & ~opaque, seen, colors)
