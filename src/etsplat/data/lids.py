"""Lids over what is open: faces that photos look through, onto the inner side of the surface behind them.

A start has no openings, so an object that is open below, a bust or a mask, gets a lid there. No silhouette shows it. If
the photos explain the lid's pixels better by the next surface behind it, which is seen from its inner side, than by the
lid itself, then nothing is where the lid is. A hollow of a solid has walls of its own, which show something else than
the inner side of the outer surface, unless all of it looks the same: then neither explains pixels better.

A lid that is fitted to photos is drawn in, until it lies on what is behind it, and then it shows the same; so it is
best found on the hull that a run starts from, and where that is too coarse, early.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from etsplat import _native
from etsplat.data.agreement import differences, per_pixel
from etsplat.data.dataset import Dataset
from etsplat.data.photos import Photo, first_hits, photos_of
from etsplat.geometry.discs import cut_open
from etsplat.geometry.measures import face_areas
from etsplat.geometry.topology import MeshTopology, connected

_WRONG = 0.02
"""Mean difference of colours from which the photos are said to show something else than a face, and by so much more
than the median of all faces differs a lid as a whole: how well faces fit depends on how far a run is."""

_BETTER, _CLEARLY = 0.9, 0.4
"""What is behind a lid differs from the photos at most so many times as much as its faces do; and for the lid as a
whole that holds of what is above the median of all faces."""

_MOST, _MUCH = 0.9, 0.125
"""So many of the photos must be explained better by what is behind, of those that see at least so many pixels of a lid
beside the one that sees most of it. Of lids all are, of sides of a blowtorch of brass 0.5 to 0.7."""

_FEWEST = 3
"""Photos that must see a lid at least, and the root of their number where that is more: a wooden handle looked like
a lid in five of 55, and lids are seen from two fifths of all directions."""

_LEAST = 0.005
"""Share of the surface that a lid has at least: for less a mesh is better closed."""

_GAP = 6
"""Gaps in lids belong to them where they are narrower than a third of a square with as many faces."""

Lids = Callable[[Float[Tensor, "V 3"], Int64[Tensor, "F 3"], Float[Tensor, "F 3"]], Bool[Tensor, " F"]]
"""Of vertices, faces and their colours, on the CPU, which faces are lids."""

Exposures = Callable[[], Mapping[int, Float[Tensor, "3 3"]]]
"""By what matrix each training view's photo has other colours than the surface, as far as that is known by now."""


def lids(dataset: Dataset, exposures: Exposures | None = None) -> Lids:
    """Which faces of a surface the training views look through, as a function of it and its colours.

    Args:
        dataset: photos with alpha around an object in the unit ball.
        exposures: asked each time; None for photos that were all exposed alike. Where one is darker than another faces
            differ from both, and of some what is behind is nearer by chance.
    """
    photos = photos_of(dataset)
    if exposures is None:
        return _lids(photos)

    def marked(vertices: Tensor, faces: Tensor, colors: Tensor) -> Tensor:
        known = exposures()
        neutral = [_neutral(photo, known[view]) for view, photo in zip(dataset.train, photos, strict=True)]
        return _lids(neutral)(vertices, faces, colors)

    return marked


@torch.no_grad()
def without_lids(
    dataset: Dataset, vertices: Float[Tensor, "V 3"], faces: Int64[Tensor, "F 3"]
) -> tuple[Float[Tensor, "V2 3"], Int64[Tensor, "F2 3"]]:
    """A surface without its lids, with a border where they were; as it is if there are none.

    Args:
        dataset: photos with alpha around an object in the unit ball.
        vertices: (V, 3) of a closed, oriented manifold, such as `visual_hull` gives.
        faces: (F, 3) of it.
    """
    photos = photos_of(dataset)
    lid = _lids(photos)(vertices, faces, _shown(photos, vertices, faces))
    if not bool(lid.any()) or bool(lid.all()):
        return vertices, faces
    source, kept, _ = cut_open(faces[~lid], len(vertices))
    return vertices[source], kept


def _lids(photos: list[Photo]) -> Lids:
    @torch.no_grad()
    def marked(vertices: Tensor, faces: Tensor, colors: Tensor) -> Tensor:
        corners = vertices.index_select(0, faces.reshape(-1)).view(-1, 3, 3)
        normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        drawn = faces.to(torch.int32)

        def looks() -> Iterator[Float[Tensor, "F 3"]]:
            return (_wrong(photo, vertices, drawn, corners[:, 0], normals, colors) for photo in photos)

        wrong = torch.zeros(len(faces), 3)
        for look in looks():
            wrong += look
        pairs = MeshTopology.from_faces(faces, len(vertices)).face_pairs.long()
        found, patch = _patches(wrong, face_areas(vertices, faces), pairs)
        if bool(found.any()):  # photos are asked one by one then, rather than all that they said kept
            found = found.index_put((found,), _told_by_most(looks(), found, patch))
        return _without_gaps(found, faces) if bool(found.any()) else found

    return marked


def _neutral(photo: Photo, matrix: Float[Tensor, "3 3"]) -> Photo:
    """A photo in the colours of the surface."""
    colors, alpha = photo.pixels.split([3, 1], dim=1)
    colors = torch.einsum("ij,bjhw->bihw", torch.linalg.inv(matrix), colors)
    return replace(photo, pixels=torch.cat([colors, alpha], dim=1))


def _shown(photos: list[Photo], vertices: Tensor, faces: Tensor) -> Float[Tensor, "F 3"]:
    """The mean colour that photos show at each face; black where none sees it."""
    sums = torch.zeros(len(faces), 4)
    for photo in photos:
        hit = first_hits(photo, vertices, faces)[1]
        at = (hit >= 0) & (photo.pixels[0, 3] > 0.95)
        shown = torch.cat([torch.ones(int(at.sum()), 1), photo.pixels[0, :3, at].T], dim=1)
        sums.index_add_(0, hit[at], shown)
    return sums[:, 1:] / sums[:, :1].clamp_min(1)


def _wrong(
    photo: Photo, vertices: Tensor, faces: Tensor, corners: Tensor, normals: Tensor, colors: Tensor
) -> Float[Tensor, "F 3"]:
    """Of each face, the pixels at which a photo sees it, and the sums there of two differences.

    The first is that of the face, the second of the nearest face behind it that turns its back to the camera: on a
    closed surface that is where the line of sight leaves the matter that it enters here.

    Args:
        photo: which looks.
        vertices: (V, 3).
        faces: (F, 3).
        corners: (F, 3) a point of each face.
        normals: (F, 3), of any length.
        colors: (F, 3).
    """
    size = photo.pixels.shape[2:]
    entered, left = torch.empty(size, dtype=torch.int64), torch.empty(size, dtype=torch.int64)
    turned = ((corners - photo.center) * normals).sum(dim=1) > 0
    _native.enter_and_leave(**photo.drawing(vertices, faces), turned=turned, entered=entered, left=left)
    return differences(photo, entered, [entered, left], colors)


def _patches(
    wrong: Float[Tensor, "F 3"], area: Float[Tensor, " F"], pairs: Int64[Tensor, "P 2"]
) -> tuple[Bool[Tensor, " F"], Int64[Tensor, " F"]]:
    """Faces in patches that what is behind explains better, and large, and as a whole nearly as well as usual.

    And the patch of each face.
    """
    own, behind = per_pixel(wrong, pairs).unbind(dim=1)
    seen = wrong[:, 0] > 0
    usual = own[seen].median() if bool(seen.any()) else own.new_zeros(())
    marked = (own > _WRONG) & (behind < _BETTER * own)
    count, patch = connected(pairs[marked[pairs].all(dim=1)], len(marked))
    sums = torch.zeros(count, 4).index_add(0, patch, torch.cat([area[:, None], wrong], dim=1) * marked[:, None])
    more, less = (sums[:, 2:] / sums[:, 1:2].clamp_min(1e-30) - usual).unbind(dim=1)
    lid = (sums[:, 0] > _LEAST * area.sum()) & (more > _WRONG) & (less < _CLEARLY * more)
    return marked & lid[patch], patch


def _told_by_most(
    looks: Iterator[Float[Tensor, "F 3"]], found: Bool[Tensor, " F"], patch: Int64[Tensor, " F"]
) -> Bool[Tensor, " M"]:
    """Of each face in a patch, whether what is behind that explains nearly every photo better that sees much of it.

    On what is glossy photos differ from each other, and some from the face by more than from anything; so do any two.
    """
    names, of = patch[found].unique(return_inverse=True)
    each = torch.stack([torch.zeros(len(names), 3).index_add(0, of, look[found]) for look in looks])
    pixels, own, behind = each.unbind(dim=2)
    sees = pixels > _MUCH * pixels.amax(dim=0)
    told, asked = (sees & (behind < own)).sum(dim=0), sees.sum(dim=0)
    return ((told >= _MOST * asked) & (asked >= max(_FEWEST, math.isqrt(len(each)))))[of]


def _without_gaps(lid: Bool[Tensor, " F"], faces: Int64[Tensor, "F 3"]) -> Bool[Tensor, " F"]:
    """A lid with the gaps in it: what is left when it has grown, and what is around that as much."""
    rings = max(1, round(float(lid.sum()) ** 0.5 / _GAP))
    around = lid
    for _ in range(rings):
        around = _grown(around, faces)
    around = ~around
    for _ in range(rings):
        around = _grown(around, faces)
    return lid | ~around


def _grown(some: Bool[Tensor, " F"], faces: Int64[Tensor, "F 3"]) -> Bool[Tensor, " F"]:
    """Some faces, and all that have a vertex of theirs."""
    corner = torch.zeros(int(faces.max()) + 1, dtype=torch.bool)
    corner[faces[some]] = True
    return corner[faces].any(dim=1)
