"""Silhouettes with their cameras: how deep points are within them, and whether they contradict each other."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from etsplat import _native
from etsplat.core.cameras import camera_centers
from etsplat.data.camera_coverage import axes_meeting_point
from etsplat.data.dataset import Dataset
from etsplat.data.pictures import Pixels, as_float

_RAYS, _LEAST_RAYS = 4096, 8
"""Pixels that are asked for, in all views together, and of each at least."""

_SAMPLES, _FINER = 96, (9, 9)
"""Points along the line of sight of each, and then around the best of these."""

_CHUNK = 1 << 10
"""Lines of sight that are looked along together."""

_FAR, _LEAST_FAR = 0.03, 3.0
"""Pixels further outside than this fraction of a silhouette's size, and no less than so many, are a contradiction."""

_FEWEST = 6
"""With fewer views nobody can say which of them is wrong."""

_EXCLUDES, _EXCEEDS = 0.01, 0.2
"""A view is left out if it excludes so large a part of what the others show, or if they exclude so much of its own."""

_ALONE = 4.0
"""And if it does so many times as much as others do."""

_ALL_AROUND = 0.9
"""Of the border of a photo: where silhouettes have more of it in most, inside and outside were taken for each other."""

_ACROSS = 0.2
"""Directions cross if the second of the principal moments of their unit vectors is this large: two at 53 degrees."""

_KEPT = 0.75
"""So many of the views are kept at least."""


def silhouette(photo: Pixels) -> Bool[np.ndarray, "H W"]:
    """Where a photo shows the object: alpha from 0.5 on; everywhere without alpha."""
    return as_float(photo[..., 3]).numpy() >= 0.5 if photo.shape[-1] == 4 else np.ones(photo.shape[:2], dtype=bool)


def touches_border(mask: Bool[np.ndarray, "H W"]) -> bool:
    """Whether a silhouette goes on, as far as one knows, beyond its picture."""
    return any(edge.any() for edge in (mask[0], mask[-1], mask[:, 0], mask[:, -1]))


def looks_inverted(dataset: Dataset) -> bool:
    """Whether most training photos show the object along nearly all of their border, and do not where it is inside."""
    found = 0
    for view in dataset.train:
        mask = silhouette(dataset.images[view])
        border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
        found += bool(border.mean() > _ALL_AROUND and not mask.all())
    return 2 * found > len(dataset.train)


class Silhouette:
    """Where a view shows the object, with its camera.

    Attributes:
        inside: (H, W) the mask.
        whole: whether it shows all of the object, and so excludes what is outside of its picture.
        distance: (1, 1, H, W) pixels to its outline, negative outside.
    """

    def __init__(self, dataset: Dataset, index: int) -> None:
        photo = dataset.images[index]
        self.inside = inside = silhouette(photo)
        # From pixel centres to the border between pixels, which partly covered pixels place within themselves.
        within, beyond = (np.asarray(distance_transform_edt(mask)) for mask in (inside, ~inside))
        distance = within - beyond
        distance -= np.copysign(0.5, distance)
        if photo.shape[-1] == 4:
            alpha = as_float(photo[..., 3]).numpy()
            distance = np.where((alpha > 0) & (alpha < 1), alpha - 0.5, distance)
        self.distance = torch.from_numpy(distance).float()[None, None]
        self.whole = not touches_border(inside)
        self.viewmat, self.K = dataset.viewmats[index].float(), dataset.Ks[index].float()

    def rays(self, count: int) -> tuple[Float[Tensor, "3"], Float[Tensor, "R 3"]]:
        """The camera's centre, and unit directions of so many pixels of the object, evenly spread over its rows."""
        inside = np.flatnonzero(self.inside)
        chosen = inside[np.linspace(0, len(inside) - 1, min(count, len(inside))).round().astype(np.int64)]
        row, column = np.unravel_index(chosen, self.inside.shape)
        return camera_centers(self.viewmat[None])[0], self.directions(row, column)

    def directions(self, row: np.ndarray, column: np.ndarray) -> Float[Tensor, "R 3"]:
        """Unit vectors from the camera's centre through the centres of pixels."""
        pixel = torch.from_numpy(np.stack([column + 0.5, row + 0.5, np.ones(len(row))], axis=1)).float()
        direction = torch.linalg.solve(self.K, pixel.T).T @ self.viewmat[:3, :3]
        return torch.nn.functional.normalize(direction, dim=1)

    def judges(self, points: Float[Tensor, "N 3"]) -> Bool[Tensor, " N"]:
        """Whether it judges each of these: it does what lies before it, and in its picture unless it shows all."""
        x, y, z = (points @ self.viewmat[:3, :3].T + self.viewmat[:3, 3]).unbind(dim=1)
        if self.whole:
            return z > 0
        height, width = self.inside.shape
        column, row = self.K[0, 0] * x / z + self.K[0, 2], self.K[1, 1] * y / z + self.K[1, 2]
        return (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)

    @property
    def far(self) -> float:
        """Pixels, by which masks of it may be off without anyone being wrong."""
        return max(_LEAST_FAR, _FAR * float(self.inside.sum()) ** 0.5)


@dataclass(frozen=True)
class Evidence:
    """Pixels of the object, and what the views say of the point on each one's line of sight that most can agree on.

    Attributes:
        view: (R,) whose pixel it is.
        depth: (R, N) how deep the point is within each silhouette, in pixels; infinite where one does not judge.
        excluded: (R, N) where it is so far outside that either mask is wrong.
    """

    view: Int64[Tensor, " R"]
    depth: Float[Tensor, "R N"]
    excluded: Bool[Tensor, "R N"]

    @staticmethod
    def of(views: Sequence[Silhouette], center: Float[Tensor, "3"], radius: float) -> "Evidence":
        """Looks along lines of sight through a ball."""
        count = max(_LEAST_RAYS, _RAYS // len(views))
        lines = [view.rays(count) for view in views]
        starts = torch.cat([start.expand_as(along) for start, along in lines])
        along = torch.cat([along for _, along in lines])
        view = torch.arange(len(views)).repeat_interleave(torch.tensor([len(along) for _, along in lines]))
        nearest, half = within_ball(starts, along, center, radius)
        chunks = zip(*(x.split(_CHUNK) for x in (starts, along, nearest, half)), strict=True)
        depth = torch.cat([_best_along(views, *chunk) for chunk in chunks])
        return Evidence(view, depth, depth < -torch.tensor([view.far for view in views]))


def within_ball(start: Tensor, along: Tensor, center: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """(R,) where lines of sight are in the middle of a ball, and (R,) how far they are within it on either side."""
    middle = ((center - start) * along).sum(dim=1)
    aside = (start + middle[:, None] * along - center).norm(dim=1)
    return middle, (radius**2 - aside**2).clamp_min((0.1 * radius) ** 2).sqrt()


def points_along(
    start: Float[Tensor, "R 3"], along: Float[Tensor, "R 3"], t: Float[Tensor, "R S"]
) -> Float[Tensor, "RS 3"]:
    """Points on lines of sight at S distances on each."""
    return (start[:, None] + t[..., None] * along[:, None]).view(-1, 3)


def _asked(views: Sequence[Silhouette], points: Tensor) -> dict[str, Any]:
    """Arguments of native calls that ask views about points."""
    return {
        "distances": [view.distance for view in views],
        "viewmats": torch.stack([view.viewmat for view in views]),
        "Ks": torch.stack([view.K for view in views]),
        "whole": torch.tensor([view.whole for view in views]),
        "points": points.contiguous(),
    }


def judged_across(views: Sequence[Silhouette], points: Float[Tensor, "N 3"]) -> Bool[Tensor, " N"]:
    """Whether those that judge a point look at it from directions that cross.

    What is seen along one line alone has no end on it: silhouettes leave spikes there, towards the cameras.
    """
    sums, count = points.new_zeros(len(points), 3, 3), points.new_zeros(len(points))
    for view in views:
        judges = view.judges(points).to(points)
        along = torch.nn.functional.normalize(points - camera_centers(view.viewmat[None]).to(points), dim=1)
        sums += judges[:, None, None] * along[:, :, None] * along[:, None, :]
        count += judges
    return torch.linalg.eigvalsh(sums / count.clamp_min(1)[:, None, None])[:, 1] >= _ACROSS


def lowest_depths(
    views: Sequence[Silhouette],
    points: Float[Tensor, "N 3"],
    count: int,
    *,
    grown: float = 0.0,
    in_units: bool = False,
    own: Int64[Tensor, " N"] | None = None,
) -> tuple[Float[Tensor, "K N"], Float[Tensor, " N"]]:
    """How deep points are within silhouettes: the least depths, ascending, and how many views judge.

    Depths are in pixels, negative outside, and infinite where so many views do not judge: one does what lies before it,
    and in its picture unless that shows all of the object.

    Args:
        views: which are asked.
        points: (N, 3).
        count: how many depths of each point.
        grown: pixels by which silhouettes are taken to be larger.
        in_units: depths are in units of the scene.
        own: (N,) a view that does not judge each; None for no such view.
    """
    depth, judges = torch.empty(count, len(points)), torch.empty(len(points))
    rule = {"own": own, "grown": grown, "in_units": in_units}
    _native.lowest_depths(**_asked(views, points), **rule, depth=depth, judges=judges)
    return depth, judges


def _best_along(views: Sequence[Silhouette], starts: Tensor, along: Tensor, middle: Tensor, half: Tensor) -> Tensor:
    """(R, N) depths of the point on each line that the fewest exclude, within `half` of its `middle`."""
    every = torch.arange(len(starts))
    most = 2 * torch.tensor([view.far for view in views])  # views that are right outvote one that is not
    for samples in (_SAMPLES, *_FINER):
        t = middle[:, None] + half[:, None] * torch.linspace(-1, 1, samples)
        cost = torch.empty(t.numel())
        _native.exclusion_costs(**_asked(views, points_along(starts, along, t)), most=most, cost=cost)
        choice = cost.view(t.shape).argmin(dim=1)
        middle, half = t[every, choice], half * 2 / (samples - 1)
    best = points_along(starts, along, middle[:, None])
    return torch.stack([lowest_depths([view], best, 1)[0][0] for view in views], dim=1)


def contradicting(dataset: Dataset) -> list[int]:
    """Views whose masks cannot be of the object that the others show: training views, worst first, then test views.

    Each pixel of the object has a point on its line of sight that is in all silhouettes, if masks and poses are right.
    A view that by itself excludes much of what the others show is wrong, and so is one much of which the others
    exclude. Test views are asked of those training views that are right, and do not speak against these. At most a
    quarter of the views are named each time, none where fewer than six train.

    Args:
        dataset: photos with alpha around an object, in any frame.

    Returns:
        Their indices; none where a mask is empty, which `bounding_sphere` refuses.
    """
    center = axes_meeting_point(dataset.viewmats[dataset.train].float())
    if center is None or len(dataset.train) < _FEWEST:
        return []
    silhouettes = {index: Silhouette(dataset, index) for index in (*dataset.train, *dataset.test)}
    if not all(view.inside.any() for view in silhouettes.values()):
        return []
    wrong = _wrong(silhouettes, dataset.train, dataset.train, center.float())
    right = [index for index in dataset.train if index not in wrong]
    return wrong + _wrong(silhouettes, [*right, *dataset.test], dataset.test, center.float())


def _wrong(
    silhouettes: Mapping[int, Silhouette], views: Sequence[int], asked: Sequence[int], center: Float[Tensor, "3"]
) -> list[int]:
    """Which of those views that are `asked` contradict the other views, worst first."""
    left, wrong = list(views), []
    while len(wrong) < len(asked) and len(left) >= max(_FEWEST, _KEPT * len(views) + 1):
        seen = [silhouettes[index] for index in left]
        guilt = dict(zip(left, _guilt(seen, Evidence.of(seen, center, reach_of(seen, center))).tolist(), strict=True))
        worst = max((index for index in asked if index not in wrong), key=guilt.__getitem__)
        if guilt[worst] < 1:
            break
        wrong.append(worst)
        left.remove(worst)
    return wrong


def _guilt(views: Sequence[Silhouette], evidence: Evidence) -> Float[Tensor, " N"]:
    """From 1 on a view is to be left out."""
    N = len(views)
    excluded = evidence.excluded
    blame = excluded / excluded.sum(dim=1, keepdim=True).clamp_min(1)
    excludes = blame.sum(dim=0) / len(blame)
    lost = excluded.any(dim=1).float()
    exceeds = torch.zeros(N).index_add(0, evidence.view, lost) / torch.bincount(evidence.view, minlength=N)
    guilt = torch.stack([excludes / _EXCLUDES, exceeds / _EXCEEDS])
    alone = torch.stack([x > _ALONE * x.median() for x in (excludes, exceeds)])
    return torch.where(alone, guilt, 0.0).amax(dim=0)


def reach_of(views: Sequence[Silhouette], center: Tensor) -> float:
    """Radius of a ball about the point that holds the object, by what most views show."""
    radii = []
    for view in views:
        start, along = view.rays(64)
        nearest = (along @ (center - start)).clamp_min(0)
        radii.append((start + nearest[:, None] * along - center).norm(dim=1).max())
    return 1.2 * float(torch.stack(radii).median())
