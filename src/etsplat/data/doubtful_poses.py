"""What can be read, and is probably wrong: cameras that are none of the photos', odd lenses, straight alpha."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.data.camera_coverage import axes_meeting_point
from etsplat.data.dataset import Dataset, middles_of
from etsplat.data.georeferencing import middle_and_spread

_CAMERAS, _POINTS = 200, 4000
"""So many are looked at, at most."""

_BEHIND = 20
"""A camera with so many times more points behind than before it, within its frame, looks away from them."""

_AWAY = 0.9
"""Of the cameras: if more than so many see no points, either are wrong."""

_ABOUT = 3.0
"""Times the spread of the cameras: what lies farther away is not between them."""

_STRAIGHT = 0.8
"""The least cosine between an axis and the way from the middle to its camera, where that looks straight outward."""

_SHORTEST = 0.05
"""Of a photo's side: the focal length that shows 169 degrees of it, which no lens without distortion does."""

_NO_BASELINE = 1e-3
"""Of the distance to the points: cameras that are spread no farther see the same, but for their turns."""


def doubts(dataset: Dataset) -> tuple[str, ...]:
    """What is probably wrong with photos and cameras, a sentence each; whether from files or made in memory."""
    return (*_alpha_notes(dataset), *_lens_notes(dataset), *_pose_notes(dataset))


def with_doubts(dataset: Dataset) -> Dataset:
    """The same, whose notes say what is probably wrong with it."""
    return replace(dataset, notes=tuple(dict.fromkeys((*dataset.notes, *doubts(dataset)))))


def _alpha_notes(dataset: Dataset) -> tuple[str, ...]:
    """Of photos that are not premultiplied, though they are to be."""
    if not (straight := dataset.images.straight):
        return ()
    some = ", ".join(dataset.names[index] for index in straight[:3]) + (", ..." if len(straight) > 3 else "")
    return (f"colours above their alpha in {some}: photos with alpha must be premultiplied, rgb * alpha",)


def _pose_notes(dataset: Dataset) -> tuple[str, ...]:
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
    if points is None and _look_outward(dataset):
        return (
            "all cameras look away from what is between them, as in a panorama: if photos show what stands there, the"
            " poses have other axes (transforms.json has OpenGL's cameras, y up and looking along -z: negate the second"
            " and third column of each transform_matrix; docs/conventions.md)",
        )
    return ()


def _lens_notes(dataset: Dataset) -> tuple[str, ...]:
    """What is probably wrong with focal lengths and principal points, as where they are parts of the photos' sides."""
    sides = torch.tensor(dataset.images.sizes, dtype=dataset.Ks.dtype)
    focal, middle = dataset.Ks[:, [0, 1], [0, 1]], dataset.Ks[:, :2, 2]
    wide = int((focal < _SHORTEST * sides).any(dim=1).sum())
    outside = int(((middle < 0) | (middle > sides)).any(dim=1).sum())
    of, notes = f"of {len(sides)} photos", []
    if wide:
        notes.append(
            f"{wide} {of} would show more than 168 degrees: are focal lengths in pixels, of photos of the size that the"
            " capture says?"
        )
    if outside:
        notes.append(
            f"{outside} {of} have the optical axis beside them: unless they were cut out of larger ones, correct the"
            " principal point, in pixels from the upper left corner"
        )
    return tuple(notes)


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


def _look_outward(dataset: Dataset) -> bool:
    """Whether the training cameras' axes meet between them, and behind nearly all of them."""
    viewmats, centers = dataset.viewmats[dataset.train], dataset.centers[dataset.train]
    met = axes_meeting_point(viewmats)
    if met is None:
        return False
    ways = centers - met
    distances = ways.norm(dim=1)
    if float(distances.median()) > _ABOUT * middle_and_spread(centers)[1]:
        return False
    outward = (ways * viewmats[:, 2, :3]).sum(dim=1) > _STRAIGHT * distances
    return float(outward.double().mean()) > _AWAY
