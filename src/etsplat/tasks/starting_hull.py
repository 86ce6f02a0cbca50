"""The visual hull that a reconstruction starts from: as fine as its thin parts need."""

from typing import Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from etsplat.core.errors import InputError
from etsplat.data.agreement import Photo, first_hits, photos_of
from etsplat.data.dataset import Dataset
from etsplat.data.false_handles import silhouette_errors
from etsplat.data.visual_hull import NEAR, Distance, visual_hull, without_specks
from etsplat.geometry.decimation import decimated
from etsplat.geometry.parts import Shape, shape_of
from etsplat.tasks.reconstruct_config import ReconstructConfig

_UNCOVERED, _LESS = 0.0005, 0.9
"""A hull that leaves more of the silhouettes uncovered lacks thin parts if a finer one leaves at most so many times as
much: what rough masks leave does not depend on how fine it is."""

_LACKING, _WIRES, _FINEST = 0.005, 0.02, 4
"""Where a hull leaves more than the first of the silhouettes uncovered, one is tried that has thin parts whole, and if
that is no better one of up to so many times as many faces: around wires they are small. Where it leaves more than the
second, that is tried at once."""

_THIN, _FINE = 0.5, 60_000
"""It is taken if it differs from silhouettes in at most so many times as many pixels: gaps beside thin parts may close
by it. By one of so many faces, which is decimated then, fewer close: that is taken by the same measure, beside one with
thin parts and as many faces."""

_BIT = 12
"""Parts of fewer faces than that which decimation leaves are bits of what it pinched off."""

Grid = Literal["plain", "thin", "fine"]
"""How a hull is contoured: as it is; with parts whole that are thinner than cells; or so from many more, decimated."""


class Hull(NamedTuple):
    """The visual hull, before false handles go and hollows are opened.

    Attributes:
        vertices: (V, 3), in the unit frame.
        faces: (F, 3).
        wanted: about how many faces it should have.
        uncovered: the part of silhouettes that is more than a pixel beside what it covers, in the mean.
        grid: the one that it comes from.
    """

    vertices: Tensor
    faces: Tensor
    wanted: int
    uncovered: float
    grid: Grid = "plain"


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
    if hull.uncovered > _LACKING and (thin := _with_thin_parts(views, hull, config)) is not None:
        return thin
    if len(hull.faces) == 0:
        raise InputError(
            "start.shape: the masks have no point in common, so there is no hull; check that masks are white inside the"
            " object, that poses and images belong together, and that the object is no flat sheet, whose mask is empty"
            " from its side: give it a thickness"
        )
    return hull


def _with_thin_parts(views: Dataset, hull: Hull, config: ReconstructConfig) -> Hull | None:
    """A hull whose thin parts are whole, if that fits silhouettes clearly better."""
    wanted, radius, most = hull.wanted, config.start.radius, _THIN * _differs(views, hull)
    few = many = _carved(views, wanted, radius, "thin")
    differs = few_differ = _differs(views, few)
    if hull.uncovered > _WIRES or differs > most:
        many = _carved(views, min(_FINEST * wanted, most_faces(config)), radius, "thin")
        differs = _differs(views, many)
    if len(many.faces) > config.max_faces or differs > most:
        return None
    fine = _carved(views, wanted, radius, "fine")
    return fine if _differs(views, fine) <= _THIN * few_differ else many


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


def _carved(views: Dataset, faces: int, radius: float, grid: Grid = "plain") -> Hull:
    """A hull of about so many faces; where the silhouettes have no point in common it has none, and covers nothing."""
    surface = contoured(views, faces, radius, grid)
    return Hull(*surface, faces, uncovered(photos_of(views), *surface) if len(surface[1]) else 1.0, grid)


def contoured(
    views: Dataset, faces: int, radius: float, grid: Grid, free: Distance | None = None
) -> tuple[Tensor, Tensor]:
    """The surface of a hull, as `visual_hull` has it."""
    count = _FINE if grid == "fine" else faces
    surface = visual_hull(views, count, radius=radius, free=free, thin=grid != "plain")
    if grid != "fine" or len(surface[1]) <= faces:
        return surface
    return without_specks(*decimated(*surface, faces), least=_BIT)  # what is decimated leaves bits where it pinches


def uncovered(photos: list[Photo], vertices: Tensor, faces: Tensor) -> float:
    """The part of silhouettes that is more than a pixel beside what a surface covers, in the mean."""
    found = []
    for photo in photos:
        covered = (first_hits(photo, vertices, faces)[1] >= 0).float()
        near = max_pool2d(covered[None, None], 3, stride=1, padding=1)[0, 0]
        alpha = photo.pixels[0, 3]
        found.append(float((alpha > 0.95)[near == 0].sum() / (alpha > 0.5).sum().clamp_min(1)))
    return sum(found) / max(1, len(found))
