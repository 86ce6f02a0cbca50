"""Poses from which nothing good can come, though they can be read: cameras that see no points, or all at one place."""

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.data.dataset import Dataset, middles_of
from etsplat.data.georeferencing import middle_and_spread

_CAMERAS, _POINTS = 200, 4000
"""So many are looked at, at most."""

_BEHIND = 20
"""A camera with so many times more points behind than before it, within its frame, looks away from them."""

_AWAY = 0.9
"""Of the cameras: if more than so many see no points, either are wrong."""

_NO_BASELINE = 1e-3
"""Of the distance to the points: cameras that are spread no farther see the same, but for their turns."""


def pose_notes(dataset: Dataset) -> tuple[str, ...]:
    """What is probably wrong with the poses of a data set with its points, in its own units; () if nothing is."""
    if dataset.exact_points is not None and _look_away(dataset, dataset.exact_points):
        return (
            "hardly a camera has points of the scene before it: the poses have other axes (transforms.json has OpenGL's"
            " cameras, y up and looking along -z; docs/conventions.md), or the points are in another frame",
        )
    middle, spread = middle_and_spread(dataset.centers)
    points = dataset.exact_points
    distance = 0.0 if points is None else float((points - middle).norm(dim=1).median())
    if spread <= _NO_BASELINE * distance:
        return (
            "all cameras are at one place, from where photos say nothing of depth: take them while walking around, or"
            " export the poses again",
        )
    return ()


def _look_away(dataset: Dataset, points: Float[Tensor, "P 3"]) -> bool:
    """Whether hardly a training camera has points before it, in its frame."""
    points = points[middles_of(range(len(points)), min(len(points), _POINTS))]
    cameras = middles_of(dataset.train, min(len(dataset.train), _CAMERAS))
    away = 0
    for index in cameras:
        seen = (points @ dataset.viewmats[index, :3, :3].T + dataset.viewmats[index, :3, 3]) @ dataset.Ks[index].T
        depth, pixels = seen[:, 2], seen[:, :2] / seen[:, 2:]
        framed = ((pixels >= 0) & (pixels <= torch.tensor(dataset.images.sizes[index]))).all(dim=1)
        away += _BEHIND * int((framed & (depth > 0)).sum()) <= int((framed & (depth < 0)).sum())
    return away > _AWAY * len(cameras)
