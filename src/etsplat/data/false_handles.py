"""Handles of a visual hull that are none of the object's: matter in its hollows that lines of sight cut into bridges.

Where several silhouettes cut into a hollow from several sides, what they leave of its filling stands in it as posts and
arches. Photos contradict each other on all of their surface, and no silhouette needs them. So a region that photos
contradict and that is no disc is replaced by discs, as long as all silhouettes stay as they are, nearly: a true handle
would leave a gap in some, and a true hole that is closed would block the light in some.

A bridge between two feet that nearly touch is no such region, and one with the feet is what silhouettes need. So then
the shortest loops that bound no disc are looked at: what is as thin as a few edges, or a hole as narrow, is cut there
and closed by two discs, if photos contradict each other along the loop, or too few see it to say, and no silhouette
needs it. Where all of a handle is as small as that, photos that agree only say that something is near.

Neither may cover a hole, however small, that the surface goes around and photos see the background through.
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from scipy.ndimage import distance_transform_edt, label, maximum, maximum_position
from torch import Tensor

from etsplat.data.agreement import COMPARED, contradicted_share, looked_by
from etsplat.data.dataset import Dataset
from etsplat.data.kept import kept
from etsplat.data.photos import Hit, Photo, first_hits, photos_of, pixel_size
from etsplat.data.visual_hull import without_specks
from etsplat.geometry.discs import with_discs
from etsplat.geometry.loops import short_loops
from etsplat.geometry.measures import mean_edge
from etsplat.geometry.parts import face_parts, genera
from etsplat.geometry.topology import MeshTopology, connected
from etsplat.geometry.windings import winds_around

_LEVELS = (0.4, 0.5, 0.6, 0.7)
"""Correlations below which photos are said to contradict each other, the surest first."""

_FEWEST = 8
"""Faces of a region that is looked at."""

_LOST, _ADDED = 0.001, 0.01
"""So much of a silhouette, in any view, may be uncovered, and so much beside it covered: a crossbar is little of it."""

_DEEP = 0.9
"""Of a mean edge, how deep what is covered beside a silhouette may be: discs overhang by less, and what is seen through
a hole in the view that shows it best is deeper, however little of a large silhouette it is."""

_SHOWN = 2
"""Pixels from its rim to the middle of a hole in a silhouette that is no fault of a mask."""

_TOLD, _PIXELS = 2, 6
"""So many photos that show a hole, by so many pixels together, are right about it: one mask may be at fault."""

_BESIDE = 0.05
"""Alpha of what is certainly beside a silhouette."""

_THIN = 8
"""Edges of a loop at most: whether a thicker handle is there photos can tell by its whole surface."""

_RINGS = 2
"""Of faces around a band along a loop, within which a small handle is with its hole."""

_SPOILT = 0.005
"""Of the surface: discs over which photos contradict a patch that is larger by more than this close a hollow."""

_BLOCKED = 0.001
"""So much beside a silhouette may be covered where a loop is cut, and no pixel of it uncovered: the gap that a cut
leaves in a spoke is narrow."""


@torch.no_grad()
def without_false_handles(
    dataset: Dataset, vertices: Float[Tensor, "V 3"], faces: Int64[Tensor, "F 3"]
) -> tuple[Float[Tensor, "V2 3"], Int64[Tensor, "F2 3"]]:
    """A hull with discs for those regions with handles that photos contradict and no silhouette needs.

    Each replacement makes the sum of the genera less, and leaves the number of parts as it is. A surface without
    handles is returned as it is.

    Args:
        dataset: photos with alpha around an object in the unit ball.
        vertices: (V, 3) of the hull, from `visual_hull`.
        faces: (F, 3) of it.
    """
    if not any(genera(faces, len(vertices))):
        return vertices, faces
    photos = photos_of(dataset)
    if len(photos) < 2:
        return vertices, faces
    views = _views_of(dataset)
    agreed = _Agreement.of(photos, vertices, faces)
    most = _errors(photos, agreed.covered) + torch.tensor([_LOST, _ADDED])
    for level in _LEVELS:
        while (simpler := _simpler(views, vertices, faces, agreed, level, most)) is not None:
            vertices, faces, agreed = simpler
            if not any(genera(faces, len(vertices))):
                return vertices, faces
    most, tried = _errors(photos, agreed.covered) + torch.tensor([0, _BLOCKED]), None
    while tried is not faces:
        tried, loops = faces, short_loops(vertices, faces)
        while (found := _cut(views, vertices, faces, agreed, most, loops)) is not None:
            vertices, faces, hits, loops = found
            if not any(genera(faces, len(vertices))):
                return vertices, faces
            agreed = _Agreement.of(photos, vertices, faces, hits)
    return vertices, faces


class _Hole(NamedTuple):
    """A hole in a silhouette.

    Attributes:
        place: (2,) farthest within, column and row.
        depth: pixels from there to its rim.
        pixels: that show the background alone.
    """

    place: Float[Tensor, "2"]
    depth: float
    pixels: int


class _Views(NamedTuple):
    """Photos that look at a surface.

    Attributes:
        photos: them.
        holes: of each, those in its silhouette.
    """

    photos: list[Photo]
    holes: list[list[_Hole]]

    @classmethod
    def of(cls, photos: list[Photo]) -> "_Views":
        return cls(photos, [_holes(photo) for photo in photos])


class _Agreement(NamedTuple):
    """What photos say of a surface.

    Attributes:
        score: (V,) how far they agree at its vertices, NaN where it is not known.
        hidden: (V,) which of them too few see.
        contradicted: the largest patch that they contradict (`contradicted_share`).
        covered: of each photo, (H, W) the pixels that it covers.
    """

    score: Float[Tensor, " V"]
    hidden: Bool[Tensor, " V"]
    contradicted: float
    covered: list[Bool[Tensor, "H W"]]

    @classmethod
    def of(cls, photos: list[Photo], vertices: Tensor, faces: Tensor, hits: list[Hit] | None = None) -> "_Agreement":
        looked = looked_by(photos, vertices, faces, hits)
        return cls(looked.score, looked.seen.sum(dim=0) < COMPARED, contradicted_share(looked), _covered(looked.hits))


@kept
def _views_of(dataset: Dataset) -> _Views:
    return _Views.of(photos_of(dataset))


def _cut(
    views: _Views, vertices: Tensor, faces: Tensor, agreed: _Agreement, most: Tensor, loops: list[list[int]]
) -> tuple[Tensor, Tensor, list[Hit], list[list[int]]] | None:
    """The surface cut along a short loop, with a smaller genus, if there is one: the shortest is tried first.

    With it come where photos see it, and those loops that were not tried and are not near the cut: to look for all
    anew takes long.

    Args:
        views: all that look.
        vertices: (V, 3).
        faces: (F, 3), with a handle.
        agreed: what photos say of it.
        most: (B, 2) errors of silhouettes that are allowed.
        loops: from `short_loops`.
    """
    before, (score, hidden, *_), least = genera(faces, len(vertices)), agreed, _smallest(faces, len(vertices))
    tried = torch.zeros(len(vertices), dtype=torch.bool)
    for number, loop in enumerate(loops):
        if len(loop) > _THIN or 2 * int(tried[loop].sum()) > len(loop):
            continue
        band = torch.isin(faces, torch.tensor(loop)).any(dim=1)
        tried[faces[band]] = True
        around = faces[band].unique()
        doubted = float(hidden[around].float().mean()) > 0.5 or float(score[around].nanmean()) < _LEVELS[-1]
        if not doubted and not _small(faces, band):
            continue
        found = without_specks(*with_discs(vertices, faces, band), least=least)
        after = genera(found[1], len(found[0]))
        if sum(after) >= sum(before) or len(after) != len(before):
            continue
        hits = _hits_within(views.photos, *found, most)
        if hits is None or _fills(views, (vertices, faces), agreed.covered, _covered(hits)):
            continue
        if doubted or not _lets_go(views, (vertices, faces), found):
            return *found, hits, _renumbered(loops[number + 1 :], vertices, found[0], around)
    return None


def _renumbered(loops: list[list[int]], before: Tensor, after: Tensor, gone: Tensor) -> list[list[int]]:
    """Short loops by their vertices' numbers after a cut, which are where they were; without those near it."""
    near = set(gone.tolist())
    number = {tuple(place): index for index, place in enumerate(after.tolist())}
    places = before.tolist()
    kept = (loop for loop in loops if len(loop) <= _THIN and near.isdisjoint(loop))
    found = ([number.get(tuple(places[index]), -1) for index in loop] for loop in kept)
    return [loop for loop in found if min(loop) >= 0]


def _small(faces: Tensor, band: Bool[Tensor, " F"]) -> bool:
    """Whether a few rings of faces around a band along a loop have all of a handle, with its hole."""
    for _ in range(_RINGS):
        band = torch.isin(faces, faces[band].unique()).any(dim=1)
    used, inside = faces[band].unique(return_inverse=True)
    topology = MeshTopology.from_faces(inside, len(used))
    rim = topology.edges.long()[topology.edge_face_counts == 1]
    ends, numbered = rim.unique(return_inverse=True)
    rims = connected(numbered, len(ends))[0] if len(rim) else 0
    return len(used) - len(topology.edges) + len(inside) + rims < 2


def _simpler(
    views: _Views, vertices: Tensor, faces: Tensor, agreed: _Agreement, level: float, most: Tensor
) -> tuple[Tensor, Tensor, _Agreement] | None:
    """The surface with a smaller genus and what photos say of it, if there is one: the largest region is tried first.

    Arguments as of `_cut`.
    """
    before, score, least = genera(faces, len(vertices)), agreed.score, _smallest(faces, len(vertices))
    low, unseen = score < level, score.isnan()
    edges = MeshTopology.from_faces(faces, len(vertices)).edges.long()
    deep = _DEEP * mean_edge(vertices, edges) / pixel_size(views.photos)
    # Of most posts photos see one side. With the other they are handles, but what is not seen may join several.
    regions = _regions(faces, low[faces].all(dim=1))
    hidden = _regions(faces, (low | unseen)[faces].all(dim=1))
    for region in [*regions, *(each for each in hidden if 2 * low[faces[each]].float().mean() >= 1)]:
        found = without_specks(*with_discs(vertices, faces, region), least=least)
        after = genera(found[1], len(found[0]))
        if sum(after) >= sum(before) or len(after) != len(before):
            continue
        hits = _hits_within(views.photos, *found, most)
        if hits is None:
            continue
        was, covered = agreed.covered, _covered(hits)
        if _closes(views.photos, was, covered, deep) or _fills(views, (vertices, faces), was, covered):
            continue
        if _lets_go(views, (vertices, faces), found):
            continue
        now = _Agreement.of(views.photos, *found, hits)
        if now.contradicted <= agreed.contradicted + _SPOILT:
            return *found, now
    return None


def _smallest(faces: Tensor, num_vertices: int) -> int:
    """Faces of the smallest part, which is to stay."""
    return int(face_parts(faces, num_vertices).bincount().min())


def _closes(photos: list[Photo], was: list[Tensor], covered: list[Tensor], deep: float) -> bool:
    """Whether more than slivers, so many pixels deep, are covered beside a silhouette that were open before."""
    for photo, before, after in zip(photos, was, covered, strict=True):
        beside = after & ~before & (photo.pixels[0, 3] < _BESIDE)
        depth = np.asarray(distance_transform_edt(np.pad(beside.numpy(), 1)))  # what is out of the frame is not beside
        if depth.max() > deep:
            return True
    return False


def _fills(views: _Views, before: tuple[Tensor, Tensor], was: list[Tensor], covered: list[Tensor]) -> bool:
    """Whether the surface went around what some silhouettes show as a hole, however small, and now covers it.

    Args:
        views: all that look.
        before: the surface as it was.
        was: what it covered.
        covered: what it covers now.
    """
    edges, told = _edges(before[1], len(before[0])), []
    for photo, holes, old, now in zip(*views, was, covered, strict=True):
        new = now & ~old
        filled = [hole for hole in holes if new[tuple(hole.place.long().tolist()[::-1])]]
        if not filled:
            continue
        places = photo.in_pixels(photo.project(before[0])[0])
        lost = [hole for hole in filled if winds_around(places, edges, hole.place)]
        told += [sum(hole.pixels for hole in lost)] if lost else []
    return len(told) >= _TOLD and sum(told) >= _PIXELS


def _lets_go(views: _Views, before: tuple[Tensor, Tensor], after: tuple[Tensor, Tensor]) -> bool:
    """Whether the surface went around a hole of a silhouette, and does not any more.

    Where the matter beside a hole is cut, and another part hides the gap, no silhouette misses anything.
    """
    edges = [_edges(faces, len(vertices)) for vertices, faces in (before, after)]
    for photo, holes in zip(*views, strict=True):
        places = [photo.in_pixels(photo.project(vertices)[0]) for vertices, _ in (before, after)]
        for hole in (each.place for each in holes if each.depth > _SHOWN):
            if winds_around(places[0], edges[0], hole) and not winds_around(places[1], edges[1], hole):
                return True
    return False


def _edges(faces: Tensor, num_vertices: int) -> Int64[Tensor, "E 2"]:
    return MeshTopology.from_faces(faces, num_vertices).edges.long()


def _holes(photo: Photo) -> list[_Hole]:
    """In the order of their rows."""
    beside = (photo.pixels[0, 3] < _BESIDE).numpy()
    around = np.pad(beside, 1, constant_values=True)  # so that all that reaches the frame is one piece
    piece = np.zeros(around.shape, dtype=np.int32)
    label(around, output=piece)
    depth, sizes = np.asarray(distance_transform_edt(around)), np.bincount(piece.ravel())
    numbers = np.setdiff1d(np.arange(1, int(piece.max()) + 1), piece[0, 0])
    middles = zip(numbers, maximum(depth, piece, numbers), maximum_position(depth, piece, numbers), strict=True)
    return [
        _Hole(torch.tensor([column - 0.5, row - 0.5]), float(deepest), int(sizes[number]))
        for number, deepest, (row, column) in middles
    ]


def _regions(faces: Tensor, low: Bool[Tensor, " F"]) -> list[Bool[Tensor, " F"]]:
    """The connected regions of some faces that are no discs, the largest first."""
    own = low.nonzero()[:, 0]
    topology = MeshTopology.from_faces(faces, int(faces.max()) + 1)
    edge, face = topology.face_edges[own].reshape(-1), torch.arange(len(own)).repeat_interleave(3)
    order = torch.argsort(edge, stable=True)
    shared = (edge[order][1:] == edge[order][:-1]).nonzero()[:, 0]
    count, label = connected(torch.stack([face[order[shared]], face[order[shared + 1]]], dim=1), len(own))
    sizes = label.bincount(minlength=count)
    found = []
    for number in torch.argsort(sizes, descending=True, stable=True).tolist():
        if sizes[number] < _FEWEST:
            break
        region = torch.zeros_like(low)
        region[own[label == number]] = True
        inside = faces[region]
        if len(inside.unique()) - len(topology.face_edges[region].unique()) + len(inside) != 1:
            found.append(region)
    return found


def silhouette_errors(photos: list[Photo], vertices: Tensor, faces: Tensor) -> Float[Tensor, "B 2"]:
    """Of each view, the pixels that the surface should cover and does not, and the reverse, per silhouette."""
    return _errors(photos, _covered(_hits(photos, vertices, faces)))


def _hits(photos: list[Photo], vertices: Tensor, faces: Tensor) -> list[Hit]:
    return [first_hits(photo, vertices, faces) for photo in photos]


def _covered(hits: list[Hit]) -> list[Bool[Tensor, "H W"]]:
    return [face >= 0 for _, face in hits]


def _hits_within(photos: list[Photo], vertices: Tensor, faces: Tensor, most: Float[Tensor, "B 2"]) -> list[Hit] | None:
    """Where photos see a surface; None where the errors of a silhouette are larger than allowed: one is enough."""
    hits = list[Hit]()
    for photo, limit in zip(photos, most, strict=True):
        hits += _hits([photo], vertices, faces)
        if bool((_errors([photo], _covered(hits[-1:])) > limit).any()):
            return None
    return hits


def _errors(photos: list[Photo], covered: list[Bool[Tensor, "H W"]]) -> Float[Tensor, "B 2"]:
    """As `silhouette_errors`, of what a surface covers."""
    found = []
    for photo, drawn in zip(photos, covered, strict=True):
        alpha = photo.pixels[0, 3]
        lost, added = ~drawn & (alpha > 0.95), drawn & (alpha < _BESIDE)
        found.append(torch.stack([lost.sum(), added.sum()]) / (alpha > 0.5).sum().clamp_min(1))
    return torch.stack(found)
