"""The visual hull that a reconstruction starts from: as fine as its thin parts need."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset
from etsplat.data.false_handles import silhouette_errors
from etsplat.data.photos import Photo, first_hits, photos_of
from etsplat.data.visual_hull import NEAR, visual_hull
from etsplat.geometry.parts import Shape, shape_of
from etsplat.tasks.reconstruct_config import ReconstructConfig

_UNCOVERED, _LESS = 0.0005, 0.9
"""A hull that leaves more of the silhouettes uncovered lacks thin parts if a finer one leaves at most so many times as
much: what rough masks leave does not depend on how fine it is."""

_LACKING, _WIRES, _FINEST = 0.005, 0.02, 4
"""Where a hull leaves more than the first of the silhouettes uncovered, one is tried that has thin parts whole, and if
that is no better one of up to so many times as many faces: around wires they are small. Where it leaves more than the
second, that is tried at once."""

_THIN, _MORE = 0.5, 0.005
"""It is taken if it differs from silhouettes in at most so many times as many pixels: gaps beside thin parts may close
by it. It may differ by so much more in the place of a hull that has more faces than a run may have."""


class Hull(NamedTuple):
    """The visual hull, before false handles go and hollows are opened.

    Attributes:
        vertices: (V, 3), in the unit frame.
        faces: (F, 3).
        wanted: about how many faces it should have.
        uncovered: the part of silhouettes that is more than a pixel beside what it covers, in the mean.
        thin: whether it has parts that are thinner than its cells.
    """

    vertices: Tensor
    faces: Tensor
    wanted: int
    uncovered: float
    thin: bool = False


@torch.no_grad()
def plain_hull(views: Dataset, config: ReconstructConfig) -> Hull:
    """The visual hull, with at most half of a run's faces; finer where thin parts of that one are broken or lacking.

    Args:
        views: of the unit frame.
        config: how many faces are wanted, and how many there may be.

    Raises:
        InputError: the views have no masks, or masks that exclude everything.
    """
    if not views.has_masks:
        raise InputError("start.shape: hull needs masks or transparent pictures; give masks, or start from a sphere")
    wanted, radius = hull_faces(config), config.start.radius
    hull, most = _carved(views, wanted, radius), most_faces(config)
    if hull.uncovered > _UNCOVERED and most > wanted:
        finer = _carved(views, min(2 * wanted, most), radius)
        if len(finer.faces) <= config.max_faces and _mends(finer, hull):
            return finer
    unfit = hull.uncovered > _LACKING or len(hull.faces) > config.max_faces
    if unfit and (thin := _with_thin_parts(views, hull, config)) is not None:
        return thin
    if len(hull.faces) == 0:
        raise InputError(
            "start.shape: the masks have no point in common, so there is no hull; check that masks are white inside the"
            " object, that poses and images belong together, and that the object is no flat sheet, whose mask is empty"
            " from its side: give it a thickness"
        )
    return hull


def _with_thin_parts(views: Dataset, hull: Hull, config: ReconstructConfig) -> Hull | None:
    """A hull whose thin parts are whole, if that fits silhouettes clearly better.

    Or nearly as well, where all is so thin that only a grid finer than a run may have sees it.
    """
    most, enough = _THIN * _differs(views, hull), min(_FINEST * hull.wanted, most_faces(config))
    if len(hull.faces) > config.max_faces:
        most += _MORE
    for faces in (hull.wanted, enough) if hull.uncovered <= _WIRES else (enough,):
        thin = _carved(views, faces, config.start.radius, thin=True)
        if len(thin.faces) <= config.max_faces and _differs(views, thin) <= most:
            return thin
    return None


def hull_faces(config: ReconstructConfig) -> int:
    """How many faces a hull has, about: at most half of a run's."""
    return min(config.start.hull_faces, max(1, config.max_faces // 2))


def _differs(views: Dataset, hull: Hull) -> float:
    """The pixels that a hull should cover and does not, and the reverse, as a part of silhouettes, in the mean."""
    if len(hull.faces) == 0:
        return 1.0
    return float(silhouette_errors(photos_of(views), hull.vertices, hull.faces).sum(dim=1).mean())


def _mends(finer: Hull, hull: Hull) -> bool:
    """Whether a finer hull covers all, and has fewer parts, or more holes: thin parts of the other one are broken."""
    whole, broken = (shape_of(each.vertices, each.faces) for each in (finer, hull))
    if finer.uncovered > _UNCOVERED or whole.parts is None or broken.parts is None:
        return False
    return whole.parts < broken.parts or (whole.parts == broken.parts and (whole.holes or 0) > (broken.holes or 0))


@torch.no_grad()
def finer_shape(hull: Hull, views: Dataset, radius: float) -> Shape | None:
    """Parts and holes of a finer hull, if it covers what this one does not, and has others.

    Args:
        hull: from `plain_hull`.
        views: of which it is.
        radius: as `visual_hull` takes it.
    """
    if hull.uncovered <= _UNCOVERED:
        return None
    finer = _carved(views, 2 * hull.wanted, radius)
    shape = shape_of(finer.vertices, finer.faces)
    covers = finer.uncovered <= _LESS * hull.uncovered
    return shape if covers and shape != shape_of(hull.vertices, hull.faces) else None


def most_faces(config: ReconstructConfig) -> int:
    """That a hull may be asked for, and not have more than a run may have."""
    return round(config.max_faces / (1 + NEAR))


def _carved(views: Dataset, faces: int, radius: float, *, thin: bool = False) -> Hull:
    """A hull of about so many faces; where the silhouettes have no point in common it has none, and covers nothing."""
    surface = visual_hull(views, faces, radius=radius, thin=thin)
    return Hull(*surface, faces, uncovered(photos_of(views), *surface) if len(surface[1]) else 1.0, thin)


def uncovered(photos: list[Photo], vertices: Tensor, faces: Tensor) -> float:
    """The part of silhouettes that is more than a pixel beside what a surface covers, in the mean."""
    found = []
    for photo in photos:
        covered = (first_hits(photo, vertices, faces)[1] >= 0).float()
        near = max_pool2d(covered[None, None], 3, stride=1, padding=1)[0, 0]
        alpha = photo.pixels[0, 3]
        found.append(float((alpha > 0.95)[near == 0].sum() / (alpha > 0.5).sum().clamp_min(1)))
    return sum(found) / max(1, len(found))
