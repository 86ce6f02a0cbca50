"""How far silhouettes are believed where they are intersected: masks that somebody brings are rough, or bitten.

A rule for the visual hull is as good as it predicts the mask of a view that it has not seen (leave-one-out). That is
measured at pixels near the outlines, where what is lost counts as much as what is too much, and the best rule is taken.
Exact masks are intersected as they are: then nothing else predicts as well.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from etsplat.core.cameras import camera_centers
from etsplat.data.silhouettes import Silhouette, judged_across, lowest_depths, points_along, within_ball

_RAYS, _LEAST_RAYS = 1024, 8
"""Pixels that are asked for on each side of the outlines, in all views together, and of each at least."""

_BAND, _LEAST_BAND = 0.04, 6.0
"""They are nearer to the outline than this fraction of the silhouette's size, or than so many pixels."""

_SAMPLES, _FINER = 96, (9, 9)
"""Points along the line of sight of each, and then around the best of these."""

_CHUNK = 1 << 10
"""Lines of sight that are looked along together."""

_MOST = 2
"""So many views may be outvoted at a point, at most."""

_QUORUMS = (0.5, 0.25, 0.125)
"""Of so many of the views a point of the hull must be judged. What less than half of them have in their frames is there
only if masks are predicted clearly better by it, and if these look at it from directions that cross."""

_CLEARLY, _SURELY = 0.9, 0.005
"""A rule with more of them errs at most so many times as often as one with fewer, and at so much less of the pixels."""

_EXACT = 0.5
"""Pixels up to which masks are taken to be exact: that is how well a pixel's edge is known."""

_FEWEST = 6
"""With fewer views nobody can say whose mask is wrong."""


@dataclass(frozen=True)
class Carving:
    """The rule by which silhouettes are intersected.

    Attributes:
        outvoted: so many views may say of a point of the hull that it is outside.
        grown: pixels by which silhouettes are taken to be larger.
        quorum: of this part of the views a point of the hull must be judged.
    """

    outvoted: int = 0
    grown: float = 0.0
    quorum: float = _QUORUMS[0]

    @classmethod
    def of(cls, views: Sequence[Silhouette], center: Float[Tensor, "3"], radius: float) -> "Carving":
        """The rule that predicts the masks of these views best, for an object in a ball."""
        if len(views) < _FEWEST:
            return cls()
        lines = _Lines.near_outlines(views, max(_LEAST_RAYS, _RAYS // len(views)))
        shown, limit = lines.shown, max(view.far for view in views)
        best, least = cls(), torch.inf
        for quorum in _QUORUMS[:1] if all(view.whole for view in views) else _QUORUMS:
            depths = torch.cat([_deepest(views, some, center, radius, quorum) for some in lines.split(_CHUNK)])
            for outvoted, depth in enumerate(depths.T):
                grown, wrong = _best_growth(depth, shown, limit)
                if wrong < min(_CLEARLY * least, least - _SURELY):
                    best, least = cls(outvoted, grown if grown > _EXACT else 0.0, quorum), wrong
        return best

    def depth(self, views: Sequence[Silhouette], points: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
        """How deep points are in the hull, in units of the scene; -inf where too few of the views judge."""
        lowest, judges = self.judged(views, points)
        return torch.where(self.known(views, points, judges), lowest, -torch.inf)

    def known(
        self, views: Sequence[Silhouette], points: Float[Tensor, "N 3"], judges: Float[Tensor, " N"], less: int = 0
    ) -> Bool[Tensor, " N"]:
        """Whether enough views judge each point: half of them, or the quorum from directions that cross.

        Args:
            views: all of them.
            points: which are judged.
            judges: how many judge each.
            less: so many of the views are not asked.
        """
        count = len(views) - less
        known = judges >= _QUORUMS[0] * count
        if self.quorum < _QUORUMS[0]:
            fewer = (~known & (judges >= self.quorum * count)).nonzero()[:, 0]
            known[fewer] = judged_across(views, points[fewer])
        return known

    def judged(
        self, views: Sequence[Silhouette], points: Float[Tensor, "N 3"]
    ) -> tuple[Float[Tensor, " N"], Float[Tensor, " N"]]:
        """How deep points are by those views that judge, infinite where none does; and how many these are."""
        depths, judges = lowest_depths(views, points, self.outvoted + 1, grown=self.grown, in_units=True)
        return depths[-1], judges


class _Lines(NamedTuple):
    """Lines of sight through pixels near outlines.

    Attributes:
        view: (R,) the view that is asked about each, and so does not judge it.
        start: (R, 3).
        along: (R, 3) unit vectors.
        shown: (R,) whether the pixel shows the object.
    """

    view: Int64[Tensor, " R"]
    start: Float[Tensor, "R 3"]
    along: Float[Tensor, "R 3"]
    shown: Bool[Tensor, " R"]

    @classmethod
    def near_outlines(cls, views: Sequence[Silhouette], count: int) -> "_Lines":
        """So many on each side of each outline, evenly spread over rows, where there are so many."""
        each = []
        for number, view in enumerate(views):
            distance = view.distance[0, 0].numpy()
            near = np.abs(distance) < max(_LEAST_BAND, _BAND * float(view.inside.sum()) ** 0.5)
            inside, beyond = (_spread(side, count) for side in (near & view.inside, near & ~view.inside))
            row, column = np.unravel_index(np.concatenate([inside, beyond]), distance.shape)
            start = camera_centers(view.viewmat[None]).expand(len(row), 3)
            shown = torch.arange(len(row)) < len(inside)
            each.append(cls(torch.full((len(row),), number), start, view.directions(row, column), shown))
        return cls(*(torch.cat(parts) for parts in zip(*each, strict=True)))

    def split(self, size: int) -> Iterator["_Lines"]:
        return (_Lines(*parts) for parts in zip(*(part.split(size) for part in self), strict=True))


def _spread(some: Bool[np.ndarray, "H W"], count: int) -> np.ndarray:
    place = np.flatnonzero(some)
    return place[np.linspace(0, len(place) - 1, min(count, len(place))).round().astype(np.int64)]


def _deepest(
    views: Sequence[Silhouette], lines: _Lines, center: Tensor, radius: float, quorum: float
) -> Float[Tensor, "R K"]:
    """How deep the deepest point on each line is, in pixels, by each number of views that are outvoted."""
    middle, half = within_ball(lines.start, lines.along, center, radius)
    each, every = [], torch.arange(len(half))
    t, found = _look(views, lines, middle, half, _SAMPLES, quorum)
    for outvoted in range(_MOST + 1):
        best, place = found[outvoted].max(dim=1)
        around, reach = t[every, place], half * 2 / (_SAMPLES - 1)
        for samples in _FINER:
            finer, depths = _look(views, lines, around, reach, samples, quorum)
            value, place = depths[outvoted].max(dim=1)
            best = torch.maximum(best, value)
            around, reach = finer[every, place], reach * 2 / (samples - 1)
        each.append(best)
    return torch.stack(each, dim=1)


def _look(
    views: Sequence[Silhouette], lines: _Lines, middle: Tensor, half: Tensor, samples: int, quorum: float
) -> tuple[Float[Tensor, "R S"], list[Float[Tensor, "R S"]]]:
    """Places along each line, and how deep the points there are by each number of views that are outvoted."""
    t = middle[:, None] + half[:, None] * torch.linspace(-1, 1, samples)
    points = points_along(lines.start, lines.along, t)
    lowest, judges = lowest_depths(views, points, _MOST + 1, own=lines.view.repeat_interleave(samples))
    known = Carving(quorum=quorum).known(views, points, judges, less=1)
    return t, list(torch.where(known, lowest, -torch.inf).view(-1, *t.shape))


def _best_growth(depth: Float[Tensor, " R"], shown: Bool[Tensor, " R"], limit: float) -> tuple[float, float]:
    """Pixels, up to `limit`, by which silhouettes must grow to predict masks best, and the share of wrong pixels."""
    needed, order = (-depth).clamp_min(0).sort(stable=True)
    gained = torch.where(shown[order], 1, -1).cumsum(dim=0)
    last = torch.cat([needed[1:] > needed[:-1], torch.tensor([True])]) & (needed <= limit)
    choices = last.nonzero()[:, 0]
    if len(choices) == 0:
        return 0.0, 1.0
    best = choices[gained[choices].argmax()]
    return float(needed[best]), float((shown.sum() - gained[best]) / len(shown))
