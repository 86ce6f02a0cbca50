"""The visual hull as a mesh: the largest shape that all silhouettes allow (Laurentini 1994).

It has the holes and the parts that the silhouettes show, so a run that starts from it need not tear a sphere; hollows
that no silhouette shows are closed in it.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float, Int64
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import max_pool2d

from etsplat.data.carving import Carving
from etsplat.data.dataset import Dataset
from etsplat.data.kept import kept
from etsplat.data.meshing import dual_contour
from etsplat.data.photos import first_hits, photos_of
from etsplat.data.silhouettes import Silhouette
from etsplat.data.thin_parts import ThinParts
from etsplat.geometry.manifold import taken_apart
from etsplat.geometry.measures import enclosed_volume
from etsplat.geometry.parts import face_parts

Distance = Callable[[Float[Tensor, "N 3"]], Float[Tensor, " N"]]
"""Of points from a surface, negative inside; it need not be exact."""

_FIRST_CELLS, _MOST_CELLS = 48, 160
"""Grid cells per side of the box, at first and at most."""

_TRIES = 3
"""Grids that are tried, to come near the number of faces that is wanted."""

NEAR = 0.15
"""How near, as a fraction of it, unless the object is too thin for any grid."""

_SPECK = 0.02
"""Parts with fewer faces than this fraction of the largest are dropped: dents of rough masks leave them."""

_FEWEST, _APART, _PIXELS, _PHOTOS = 12, 3, 4, 3
"""But not those of so many faces, so many cells from all others, that are all that explains so many pixels in so many
photos: a part is there, however small. Nearer ones are bits of what is too thin for the grid."""

_OUT = 0.15
"""So far outside of a hull, several cells of any grid, it does not matter whether space is free."""

_CHUNK = 1 << 17
"""Points that are looked up together."""

_MARGIN = 2
"""Free cells around the hull; dual contouring wants one."""

_BISECTIONS = 8
"""The surface is found to this power of 2 of a cell."""


def visual_hull(
    dataset: Dataset, faces: int, *, radius: float = 1.0, free: Distance | None = None, thin: bool = False
) -> tuple[Float[Tensor, "V 3"], Int64[Tensor, "F 3"]]:
    """The hull of the training views' silhouettes (alpha 0.5) within a ball around the origin, as a closed manifold.

    A view whose silhouette keeps off the image border excludes what its image does not show; where the border cuts the
    silhouette, nothing is known beyond. A point of the hull is judged by at least half of the views, or by fewer where
    that predicts masks better (`Carving`).

    Args:
        dataset: photos with alpha around an object at the origin, as `bounding_sphere` and `renormalized` place it.
        faces: about how many are wanted.
        radius: of the ball.
        free: positive at points that are cut away from the hull; None for the hull as it is.
        thin: parts that are thinner than cells are whole (`ThinParts`), and gaps beside them of two cells may close.

    Returns:
        vertices (V, 3) float32 and faces (F, 3) int64, counter-clockwise seen from outside; (0, 3) both if the
        silhouettes have no point in common.
    """
    outside = outside_hull(dataset)

    def beyond(points: Tensor) -> Tensor:
        found = outside(points)
        if free is not None:
            near = found < _OUT
            found[near] = torch.maximum(found[near], free(points[near]))
        return found

    def distance(points: np.ndarray) -> np.ndarray:
        chunks = torch.from_numpy(points).float().split(_CHUNK)
        found = torch.cat([beyond(chunk) for chunk in chunks]).double().numpy()
        return np.maximum(found, np.linalg.norm(points, axis=1) - radius)

    cells, cell = _FIRST_CELLS, 1.0
    vertices, triangles = np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    for _ in range(_TRIES):
        cell = 2 * radius / (cells - 2 * _MARGIN)
        corner = -0.5 * cell * cells
        lower, counts = (corner, corner, corner), (cells, cells, cells)
        if thin:
            parts = ThinParts.of(distance, cells, cell)
            values = parts.values - parts.skin
            found = dual_contour(parts.skinned, lower, cell, counts, bisections=_BISECTIONS, values=values)
            vertices, triangles = parts.without_skin(found[0]), found[1]
        else:
            vertices, triangles = dual_contour(distance, lower, cell, counts, bisections=_BISECTIONS)
        if len(triangles) == 0 or abs(len(triangles) - faces) <= NEAR * faces:
            break
        wanted = round(cells * (faces / len(triangles)) ** 0.5)
        if cells == (cells := min(max(wanted, _FIRST_CELLS // 2), _MOST_CELLS)):
            break
    found = _without_voids(*taken_apart(torch.from_numpy(vertices).float(), torch.from_numpy(triangles)))
    return without_specks(*found, spared=_shown_apart(dataset, *found, _APART * cell))


@kept
def outside_hull(dataset: Dataset) -> Distance:
    """How far points are outside the visual hull: a function of them, in units of the scene, negative inside.

    Where masks are rough or bitten they are believed as far as they predict each other (`Carving`).

    Args:
        dataset: as in `visual_hull`.
    """
    views = [Silhouette(dataset, index) for index in dataset.train]
    carving = Carving.of(views, torch.zeros(3), 1.0)

    def outside(points: Tensor) -> Tensor:
        depth = carving.depth(views, points)
        return torch.where(depth.isneginf(), 1.0, -depth)

    return outside


def _shown_apart(dataset: Dataset, vertices: Tensor, faces: Tensor, gap: float) -> list[int]:
    """The small parts of a hull that are farther than `gap` from all others, and that photos show beside the large."""
    if len(faces) == 0:
        return []
    part = face_parts(faces, len(vertices))
    sizes = part.bincount()
    large = sizes >= _SPECK * float(sizes[0])
    candidates = [int(number) for number in (~large & (sizes >= _FEWEST)).nonzero()[:, 0]]
    alone = [number for number in candidates if _gap(vertices, faces, part == number) > gap]
    if not alone:
        return []
    shown = torch.zeros(len(sizes), dtype=torch.int64)
    for photo in photos_of(dataset):
        near = first_hits(photo, vertices, faces[large[part]])[1] >= 0
        near = max_pool2d(near[None, None].float(), 3, stride=1, padding=1)[0, 0] > 0
        hit = first_hits(photo, vertices, faces)[1]
        own = hit[(hit >= 0) & ~near & (photo.pixels[0, 3] > 0.95)]
        shown += part[own].bincount(minlength=len(sizes)) >= _PIXELS
    return [number for number in alone if shown[number] >= _PHOTOS]


def _gap(vertices: Tensor, faces: Tensor, own: Tensor) -> float:
    """How far the vertices of some faces are from those of the others."""
    mine, others = (vertices[faces[which].unique()].numpy() for which in (own, ~own))
    return float(KDTree(others).query(mine)[0].min())


def _without_voids(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Only the parts of a closed surface that enclose something: what is free within another part nobody sees."""
    part = face_parts(faces, len(vertices))
    count = int(part.max()) + 1 if len(part) else 0
    turned = [number for number in range(1, count) if enclosed_volume(vertices, faces[part == number]) < 0]
    used, renumbered = faces[~torch.isin(part, torch.tensor(turned, dtype=part.dtype))].unique(return_inverse=True)
    return vertices[used], renumbered


def without_specks(
    vertices: Tensor, faces: Tensor, *, spared: Sequence[int] = (), least: float = math.inf
) -> tuple[Tensor, Tensor]:
    """Only the large parts of a surface, and the vertices that these use.

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        spared: small parts that stay, by their numbers as of `face_parts`.
        least: parts of so many faces and more stay.
    """
    if len(faces) == 0:
        return vertices[:0], faces
    part = face_parts(faces, len(vertices))
    sizes = part.bincount()
    stays = sizes >= min(_SPECK * float(sizes[0]), least)
    stays[list(spared)] = True
    used, renumbered = faces[stays[part]].unique(return_inverse=True)
    return vertices[used], renumbered
