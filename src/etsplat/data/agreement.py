"""How far photos agree on what they show at points of a surface.

That is the normalised cross-correlation of patches, so exposure does not matter, and where there is no texture nothing
is known.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn.functional import normalize

from etsplat import _native
from etsplat.data.dataset import Dataset
from etsplat.data.kept import kept
from etsplat.data.photos import Hit, Photo, blank_photos, first_hits, photos_of, pixel_size, reduced, seen_by
from etsplat.geometry.measures import face_areas, vertex_normals
from etsplat.geometry.topology import MeshTopology, connected

_PATCH = 7
"""Pixels across the patches that are compared."""

_ASKED = 12
"""At most so many photos are compared at a point: those that look at it most squarely."""

_SLANT = 0.2
"""Cosine of the angle to the normal, below which a photo is not asked."""

_FLAT = 0.01
"""Standard deviation of colours below which a patch shows nothing to compare."""

_WHOLE = 0.7
"""Share of a patch that must lie on the object for more."""

COMPARED = 3
"""Photos that see a vertex of a surface, from which on they are compared there."""

SMOOTH = 3
"""Rounds in which normals are averaged with their neighbours'."""

AGREED = 0.75
"""Correlation of photos that show one surface; those of different ones have about 0.3."""

_CONTRADICTED = 0.4
"""Correlation below which photos show different things, as on a lid over a hollow; gloss seldom goes so low."""

_FEWEST = 5
"""Photos that are enough to say that a surface is not there; the root of their number where that is less."""

_WRONG, _UNUSUAL = 0.01, 1.3
"""Mean difference of colours from which photos are said to show something else than a face does, and so many times
what it is on half of the surface: coarse faces do not show all of a texture."""

_LOOKS = 3
"""Surfaces of which it is known how they were seen: each takes a dozen bytes for each pixel of all photos."""

_SPREAD = 4
"""Rounds in which differences are summed over neighbouring faces."""


def unseen_vertices(dataset: Dataset) -> Callable[[Tensor, Tensor], Bool[Tensor, " V"]]:
    """Of a surface (V, 3), (F, 3), on the CPU, the vertices that no training view sees, as a function of it."""
    photos = blank_photos(reduced(dataset))

    def unseen(vertices: Tensor, faces: Tensor) -> Tensor:
        hits = [first_hits(photo, vertices, faces) for photo in photos]
        return ~seen_by(photos, hits, vertices, pixel_size(photos)).any(dim=0)

    return unseen


def settled(dataset: Dataset) -> Callable[[Tensor, Tensor], Float[Tensor, " V"]]:
    """Of a surface (V, 3), (F, 3), on the CPU, on what part of the vertices around each the training views agree."""
    photos = photos_of(dataset)

    @torch.no_grad()
    def part(vertices: Tensor, faces: Tensor) -> Tensor:
        looked = looked_by(photos, vertices, faces)
        return _ring_mean((looked.score >= AGREED).float(), looked.topology.edges.long())

    return part


def surface_agreement(
    photos: list[Photo], seen: Bool[Tensor, "B V"], vertices: Tensor, faces: Tensor, edges: Tensor
) -> Float[Tensor, " V"]:
    """How far photos agree at the vertices that they see, mean over a vertex and its neighbours; NaN if none is known.

    Args:
        photos: from `photos_of`.
        seen: from `seen_by`.
        vertices: (V, 3) of the surface.
        faces: (F, 3).
        edges: (E, 2).
    """
    masks = [(photo.pixels[:, 3:] >= 0.95).float() for photo in photos]
    normals = averaged(vertex_normals(vertices, faces), edges, SMOOTH)
    return _ring_mean(agreement(photos, masks, vertices, normals, seen, pixel_size(photos), fewest=COMPARED), edges)


class Looked(NamedTuple):
    """A surface as photos see it, for what is asked of it.

    Attributes:
        photos: all that look.
        vertices: (V, 3).
        faces: (F, 3).
        topology: of them.
        hits: of each photo, from `first_hits`.
        seen: (B, V) which photos see which vertices.
        score: (V,) from `surface_agreement`.
    """

    photos: list[Photo]
    vertices: Tensor
    faces: Tensor
    topology: MeshTopology
    hits: list[Hit]
    seen: Tensor
    score: Tensor


@torch.no_grad()
def looked_at(dataset: Dataset, vertices: Float[Tensor, "V 3"], faces: Int64[Tensor, "F 3"]) -> Looked | None:
    """What photos see of a surface; None where there are not two photos, or nothing to see.

    Args:
        dataset: photos with alpha around it.
        vertices: (V, 3).
        faces: (F, 3).
    """
    dataset = reduced(dataset)
    photos, looks = photos_of(dataset), _looks(dataset)
    if len(photos) < 2 or len(vertices) == 0:
        return None
    if (vertices, faces) not in looks:
        for oldest in list(looks)[: 1 - _LOOKS]:
            del looks[oldest]
        looks[vertices, faces] = looked_by(photos, vertices, faces)
    return looks[vertices, faces]


@kept
def _looks(dataset: Dataset) -> dict[tuple[Tensor, Tensor], Looked]:
    """The latest looks at surfaces: one is asked several things."""
    return {}


def looked_by(
    photos: list[Photo],
    vertices: Float[Tensor, "V 3"],
    faces: Int64[Tensor, "F 3"],
    hits: list[Hit] | None = None,
) -> Looked:
    """What photos, of `photos_of`, see of a surface; `hits` of each if they are known."""
    topology = MeshTopology.from_faces(faces, len(vertices))
    hits = hits or [first_hits(photo, vertices, faces) for photo in photos]
    seen = seen_by(photos, hits, vertices, pixel_size(photos))
    score = surface_agreement(photos, seen, vertices, faces, topology.edges.long())
    return Looked(photos, vertices, faces, topology, hits, seen, score)


def witnesses(count: int) -> int:
    """How many of so many photos must see what they contradict: of few at a slant none need be alike."""
    return min(max(math.isqrt(count), COMPARED), _FEWEST)


@torch.no_grad()
def contradicted(looked: Looked | None, colors: Float[Tensor, "F 3"]) -> float:
    """As `contradicted_share`, of a surface whose colours were fitted to the photos.

    Where the photos do not correlate and yet the colours explain them, what they show there is noise: a plain surface
    is no lid. Nor counts what few of the photos see, as in a hollow: a lid over it is seen by more, and of few photos
    at a slant none need be alike. 0 where there are no photos.

    Args:
        looked: from `looked_at`.
        colors: (F, 3) in [0, 1].
    """
    if looked is None:
        return 0.0
    photos, vertices, faces, topology, hits, seen, score = looked
    sums = torch.stack([differences(photo, hit, [hit], colors) for photo, (_, hit) in zip(photos, hits, strict=True)])
    wrong = per_pixel(sums.sum(dim=0), topology.face_pairs.long())[:, 0]
    usual = wrong[wrong > 0].median() if bool((wrong > 0).any()) else wrong.new_zeros(())
    unlike = wrong > torch.maximum(_UNUSUAL * usual, usual + _WRONG)
    enough = seen.sum(dim=0) >= witnesses(len(photos))
    return largest_patch((score < _CONTRADICTED) & enough, vertices, faces, topology.edges.long(), unlike)


@torch.no_grad()
def plain_share(looked: Looked | None) -> float:
    """The largest patch that photos see and on which they show nothing to compare, as a fraction of a surface's area.

    What lies there outlines alone say, and no outline shows a hollow. 0 where there are no photos.

    Args:
        looked: from `looked_at`.
    """
    if looked is None:
        return 0.0
    plain = looked.score.isnan() & (looked.seen.sum(dim=0) >= COMPARED)
    return largest_patch(plain, looked.vertices, looked.faces, looked.topology.edges.long())


@torch.no_grad()
def unseen_share(looked: Looked | None) -> float:
    """Faces of which no photo sees a corner, as a fraction of a surface's area; 0 where there are no photos.

    Args:
        looked: from `looked_at`.
    """
    if looked is None:
        return 0.0
    area, unseen = face_areas(looked.vertices, looked.faces), ~looked.seen.any(dim=0)
    return float(area[unseen[looked.faces].all(dim=1)].sum() / area.sum())


def mean_agreement(looked: Looked) -> float:
    """How far photos agree on a surface, in the mean over what of it is known; 0 if nothing is."""
    known = ~looked.score.isnan()
    corners = (face_areas(looked.vertices, looked.faces)[:, None] * known[looked.faces]).flatten()
    scores = looked.score.nan_to_num()[looked.faces].flatten()
    return float((corners * scores).sum() / corners.sum().clamp_min(torch.finfo(torch.float32).tiny))


def contradicted_share(looked: Looked) -> float:
    """The largest patch of a surface on which photos show different things, as a fraction of its area."""
    patch = looked.score < _CONTRADICTED
    return largest_patch(patch, looked.vertices, looked.faces, looked.topology.edges.long())


def largest_patch(
    some: Bool[Tensor, " V"], vertices: Tensor, faces: Tensor, edges: Tensor, only: Bool[Tensor, " F"] | None = None
) -> float:
    """Of the connected patches of some vertices the largest, as a fraction of the area; `only` of these faces."""
    count, patch = connected(edges[some[edges].all(dim=1)], len(vertices))
    area = face_areas(vertices, faces)
    within = some[faces].all(dim=1)
    if only is not None:
        within &= only
    patches = torch.zeros(count).index_add(0, patch[faces[within, 0]], area[within])
    return float(patches.amax() / area.sum())


def differences(
    photo: Photo, seen: Int64[Tensor, "H W"], shown: Sequence[Int64[Tensor, "H W"]], colors: Float[Tensor, "F 3"]
) -> Float[Tensor, "F K"]:
    """Of each face, at how many pixels a photo of the object sees it, and the sums there of mean absolute differences.

    Args:
        photo: one of `photos_of`.
        seen: (H, W) the face at each pixel, -1 where there is none.
        shown: (H, W) the face whose colour is compared there: a column for each.
        colors: (F, 3) in [0, 1].
    """
    sums = torch.zeros(len(colors), 1 + len(shown))
    _native.add_differences(
        pixels=photo.pixels, opaque=0.95, seen=seen, shown=shown, colors=colors.detach().contiguous(), sums=sums
    )
    return sums


def per_pixel(sums: Float[Tensor, "F K"], pairs: Int64[Tensor, "P 2"]) -> Float[Tensor, "F K-1"]:
    """Sums over each face and those around it, divided by their pixels, which come first; 0 where there is no pixel."""
    source, target = torch.cat([pairs, pairs.flip(1)]).T
    for _ in range(_SPREAD):
        sums = sums.index_add(0, target, sums[source]) / 4
    return sums[:, 1:] / sums[:, :1].clamp_min(1e-30)


def agreement(
    photos: list[Photo],
    masks: list[Tensor],
    points: Float[Tensor, "N 3"],
    normals: Float[Tensor, "N 3"],
    seen: Bool[Tensor, "B N"],
    pixel: float,
    *,
    fewest: int,
) -> Float[Tensor, " N"]:
    """Mean of the upper half of the correlations between the photos that see each point; NaN if too few do."""
    found = torch.empty(len(points))
    _native.photo_agreement(
        pixels=[photo.pixels for photo in photos],
        masks=masks,
        viewmats=torch.stack([photo.viewmat for photo in photos]),
        Ks=torch.stack([photo.K for photo in photos]),
        centers=torch.stack([photo.center for photo in photos]),
        points=points.contiguous(),
        normals=normals.contiguous(),
        seen=seen.contiguous(),
        patch=_PATCH,
        asked=_ASKED,
        slant=_SLANT,
        flat=_FLAT,
        whole=_WHOLE,
        fewest=fewest,
        pixel=pixel,
        result=found,
    )
    return found


def averaged(normals: Float[Tensor, "V 3"], edges: Int64[Tensor, "E 2"], rounds: int) -> Float[Tensor, "V 3"]:
    """Unit normals, each so many times averaged with its neighbours'."""
    source, target = torch.cat([edges, edges.flip(1)]).T
    for _ in range(rounds):
        normals = normalize(normals.index_add(0, target, normals[source]), dim=1)
    return normals


def _ring_mean(values: Tensor, edges: Tensor) -> Tensor:
    """(V,) the mean over a vertex and its neighbours of what is not NaN."""
    source, target = torch.cat([edges, edges.flip(1)]).T
    known, value = (~values.isnan()).float(), values.nan_to_num()
    return value.index_add(0, target, value[source]) / known.index_add(0, target, known[source])
