"""Hollows that no silhouette shows: a visual hull lies over them like a lid, and is pushed in to where photos agree.

Where the hull is the surface, the photos agree on what they show there; on a lid they do not. What is behind a lid is
seen by those photos whose line of sight enters the hull through a lid, since all the rest of the hull is the object
itself. With only these asked, they agree where the bottom of the hollow is, and hardly anywhere else.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from etsplat import _native
from etsplat.data.agreement import AGREED, agreement, averaged, contradicted_share, looked_at, surface_agreement
from etsplat.data.dataset import Dataset
from etsplat.data.photos import Hit, Photo, first_hits, photos_of, pixel_size, reduced, seen_by
from etsplat.data.visual_hull import Distance, outside_hull
from etsplat.geometry.measures import mean_edge, vertex_normals
from etsplat.geometry.subdivision import longest_edge_plan
from etsplat.geometry.topology import MeshTopology, connected

_STEP = 1.5
"""Pixels between two depths that are tried: an agreement is about three wide."""

_DEEPEST = 1.5
"""Depths end here, in units of the object's radius."""

_PARTLY, _BETTER, _WIDE = 0.55, 0.3, 64
"""Or so much, if that is by so much more than on the lid, and on so many vertices that it is no chance: of a deep
hollow with dark walls little is seen before it is open."""

_CONFIRMED = 0.5
"""Mean correlation on a hollow as photos see it once it is open, at least: its walls are seen at a slant."""

_GAIN, _FAR = 0.1, 0.1
"""And by so much more than on the lid before where lids go in by more than this, in units of the object's radius, in
the mean: on ribs that repeat, photos agree a rib too deep, no better."""

_LOST = 10.0
"""The correlation counts so much less, times the share of a lid's pixels at which silhouettes show what is gone once it
is open: a few along its border, many where a wall is pushed in."""

_UNKNOWN = 0.6
"""Cost of a depth where nobody can be asked; elsewhere it is 1 - agreement."""

_BEND, _TEAR = 0.03, 0.3
"""Cost of an edge for each step that its ends differ, and its bound."""

_ROUNDS = 30
"""Of belief propagation."""

_SMOOTH_LID = 20
"""Rounds in which normals of lids by themselves are averaged with their neighbours'."""

_SLENDER = 2.0
"""Hollows are at most so many times as deep as they are wide."""

_SMOOTH_UNSEEN = 100
"""Rounds in which what no two photos see comes between its neighbours."""

_PASSES = 3
"""Looks at all lids: the second sees walls where the first tore."""

_AT_ONCE = 8
"""Depths at which it is asked together whether they are still inside."""

_CHUNK = 1 << 16
"""Points at which photos are asked together."""

_LONGEST = 2.5
"""Edges longer than this times the mean of the hull's are divided."""

_FEWEST = 8
"""Vertices of a lid that is worth moving."""


class Opened(NamedTuple):
    """A hull whose hollows are open as far as photos show them.

    Attributes:
        vertices: (V2, 3).
        faces: (F2, 3), at most half as many again as before.
        moved: how many vertices moved.
        contradicted: the largest patch that photos contradicted when they were last asked (`contradicted_share`).
        doubtful: the part of the vertices that moved, or that no two photos saw then.
        agreed: the part of the vertices on which photos agreed then.
        lidded: (V, 3) and (F, 3) of the hull with its lids. None if it is not known.
        sheet: whether a lid was removed. If not, the vertices of `lidded` are the first of these.
    """

    vertices: Float[Tensor, "V2 3"]
    faces: Int64[Tensor, "F2 3"]
    moved: int
    contradicted: float
    doubtful: float
    agreed: float
    lidded: tuple[Float[Tensor, "V 3"], Int64[Tensor, "F 3"]] | None = None
    sheet: bool = False


class _Look(NamedTuple):
    """One look at all lids: where vertices are then, how many moved, and what photos said of the surface before.

    Attributes:
        vertices: (V, 3).
        moved: how many.
        contradicted: the largest patch (`contradicted_share`).
        unseen: the part of the vertices that no two photos see.
        agreed: the part on which photos agree.
    """

    vertices: Float[Tensor, "V 3"]
    moved: int
    contradicted: float
    unseen: float
    agreed: float


@torch.no_grad()
def open_hollows(
    dataset: Dataset, vertices: Float[Tensor, "V 3"], faces: Int64[Tensor, "F 3"], *, most: int | None = None
) -> Opened:
    """Pushes lids of the visual hull in to where the training views agree.

    Where there is no texture nothing moves. Depths along a lid's normal are chosen by belief propagation, smooth but
    for tears at the walls. Lids under which the photos do not agree either stay. What was stretched into walls is
    divided, and looked at again.

    Args:
        dataset: photos with alpha around an object in the unit ball.
        vertices: (V, 3) of the hull, from `visual_hull`.
        faces: (F, 3) of it.
        most: faces that it may have after it, if it has not more already; None for any number.
    """
    dataset = reduced(dataset)
    if len(photos_of(dataset)) < 2 or len(vertices) == 0:
        return Opened(vertices, faces, 0, 0.0, 1.0, 0.0, (vertices, faces))
    edge, half_more = float(_edge_lengths(vertices, faces).mean()), len(faces) * 3 // 2
    most = half_more if most is None else min(most, half_more)
    lidded, total, look = (vertices, faces), 0, _Look(vertices, 0, 0.0, 1.0, 0.0)
    outside = outside_hull(dataset)
    for _ in range(_PASSES):
        look = _push(dataset, outside, vertices, faces)
        if look.moved == 0:
            break
        total += look.moved
        vertices, faces = _divided(look.vertices, faces, _LONGEST * edge, most)
    doubtful = min(1.0, total / len(vertices) + look.unseen)
    return Opened(vertices, faces, total, look.contradicted, doubtful, look.agreed, lidded)


def _push(dataset: Dataset, outside: Distance, vertices: Tensor, faces: Tensor) -> _Look:
    """One look at all lids."""
    looked = looked_at(dataset, vertices, faces)
    assert looked is not None
    photos, hits, score, edges = looked.photos, looked.hits, looked.score, looked.topology.edges.long()
    pixel, lid = pixel_size(photos), score < AGREED
    said = (
        contradicted_share(looked),
        float(score.isnan().float().mean()),
        float((score >= AGREED).float().mean()),
    )
    own = lid.nonzero()[:, 0]
    if len(own) < _FEWEST:
        return _Look(vertices, 0, *said)
    number = torch.full((len(vertices),), -1)
    number[own] = torch.arange(len(own))
    links = number[edges[lid[edges].all(dim=1)]]

    inward = -averaged(vertex_normals(vertices, faces)[own], links, _SMOOTH_LID)
    depths = _STEP * pixel * torch.arange(int(_DEEPEST / (_STEP * pixel)) + 1)
    lids = [((hit >= 0) & (lid[faces].sum(dim=1) >= 2)[hit.clamp_min(0)]).float()[None, None] for _, hit in hits]
    free = _within(outside, vertices[own], inward, depths)
    found = torch.full(free.shape, torch.nan)
    who, which = free.nonzero(as_tuple=True)
    chunks = zip(who.split(_CHUNK), which.split(_CHUNK), strict=True)
    found[free] = torch.cat(
        [
            _agreement_behind(photos, lids, vertices[own[v]] + depths[d, None] * inward[v], -inward[v], pixel)
            for v, d in chunks
        ]
    )
    cost = torch.where(found.isnan(), _UNKNOWN, 1 - found.clamp(0, 1)).masked_fill(~free, torch.inf)
    depth = _depths(cost, links)
    edge = mean_edge(vertices, edges)
    depth = _where_agreed(depth, found, links, edge / float(depths[1]))
    way, moved = depths[depth], vertices.clone()
    moved[own] += way[:, None] * inward
    seen = seen_by(photos, [first_hits(photo, moved, faces) for photo in photos], moved[own], pixel)
    way = _without_unseen(way, seen, edges.flatten().bincount(minlength=len(vertices))[own], links)
    moved[own] = vertices[own] + way[:, None] * inward
    far = torch.zeros(len(vertices)).index_copy(0, own, way)
    deep = far > depths[1]
    way = way.masked_fill(_mistaken(photos, hits, score, moved, faces, far, deep, edges)[own], 0.0)
    moved[own] = vertices[own] + way[:, None] * inward
    return _Look(moved, int((way > depths[1]).sum()), *said)


def _divided(vertices: Tensor, faces: Tensor, longest: float, most: int) -> tuple[Tensor, Tensor]:
    """Faces with a longer edge are halved until none is left, or there are `most` faces."""
    while len(faces) < most:
        length = _edge_lengths(vertices, faces).amax(dim=1)
        wanted = int((length > longest).sum())
        if wanted == 0:
            break
        topology = MeshTopology.from_faces(faces, len(vertices))
        plan = longest_edge_plan(vertices, topology, length, min(most, len(faces) + wanted))
        if len(plan.new_vertices) == 0:
            break
        vertices = torch.cat([vertices, vertices[plan.new_vertices.long()].mean(dim=1)])
        faces = plan.faces.long()
    return vertices, faces


def _edge_lengths(vertices: Tensor, faces: Tensor) -> Tensor:
    """(F, 3) of each face."""
    return (vertices[faces] - vertices[faces.roll(1, dims=1)]).norm(dim=2)


def _agreement_behind(photos: list[Photo], lids: list[Tensor], points: Tensor, normals: Tensor, pixel: float) -> Tensor:
    """(N,) how far photos agree at points that they see through lids, which are masks (1, 1, H, W)."""
    seen = torch.stack(
        [
            photo.look_up(lid, photo.project(points)[0][None], "nearest")[0, 0] > 0.5
            for photo, lid in zip(photos, lids, strict=True)
        ]
    )
    enough = seen.sum(dim=0) >= 2
    found = torch.full((len(points),), torch.nan)
    found[enough] = agreement(photos, lids, points[enough], normals[enough], seen[:, enough], pixel, fewest=2)
    return found


def _within(outside: Distance, points: Tensor, inward: Tensor, depths: Tensor) -> Bool[Tensor, "N D"]:
    """Which depths lie before the way inwards comes within a step of the hull's other side."""
    free = torch.zeros(len(points), len(depths), dtype=torch.bool)
    free[:, :2] = True  # a lid itself, and the way to the first depth well inside of it
    going = torch.arange(len(points))
    for column in range(2, len(depths), _AT_ONCE):
        if len(going) == 0:
            break
        some = depths[column : column + _AT_ONCE]
        asked = points[going, None] + some[:, None] * inward[going, None]
        inside = outside(asked.reshape(-1, 3)).view(asked.shape[:2]) <= -depths[1]
        on = inside.int().cumprod(dim=1).bool()
        free[going, column : column + _AT_ONCE] = on
        going = going[on[:, -1]]
    return free


def _depths(cost: Float[Tensor, "N D"], edges: Int64[Tensor, "E 2"]) -> Int64[Tensor, " N"]:
    """The depths of least cost with that of the edges, by min-sum belief propagation with a truncated linear cost."""
    belief = torch.empty_like(cost)
    rules = {"bend": _BEND, "tear": _TEAR, "rounds": _ROUNDS}
    _native.propagate_beliefs(cost=cost.contiguous(), edges=edges.contiguous(), **rules, belief=belief)
    return belief.argmin(dim=1)


def _where_agreed(depth: Tensor, found: Tensor, edges: Tensor, edge: float) -> Tensor:
    """The depths, 0 for lids under which photos agree no more than on a lid, and for those that hardly move.

    Hollows much deeper than wide are no hollows: no two photos could see their bottom. The length of an edge, by which
    widths are known, is given in depths.
    """
    at = found.gather(1, depth[:, None])[:, 0]
    deep = depth > 1
    count, lid = connected(edges[deep[edges].all(dim=1)], len(depth))
    size = torch.zeros(count).index_add(0, lid, deep.float())
    agreement, asked = _means(at, lid, count)
    closed, _ = _means(found[:, 0], lid, count)
    deepest = torch.zeros(count).scatter_reduce(0, lid, depth.float(), "amax")
    partly = (size >= _WIDE) & (agreement >= _PARTLY) & (agreement - closed >= _BETTER)
    opened = (size >= _FEWEST) & (2 * asked >= size) & ((agreement >= AGREED) | partly)
    opened &= deepest <= _SLENDER * edge * size.sqrt()
    return _without_shafts(torch.where(deep & opened[lid], depth, 0), edges, edge)


def _means(values: Float[Tensor, " N"], group: Int64[Tensor, " N"], count: int) -> tuple[Tensor, Tensor]:
    """(count,) means of what is known of each group, and how many of it are."""
    known = torch.zeros(count).index_add(0, group, (~values.isnan()).float())
    return torch.zeros(count).index_add(0, group, values.nan_to_num()) / known.clamp_min(1), known


def _mistaken(
    photos: list[Photo],
    before: list[Hit],
    score: Float[Tensor, " V"],
    moved: Float[Tensor, "V 3"],
    faces: Int64[Tensor, "F 3"],
    far: Float[Tensor, " V"],
    deep: Bool[Tensor, " V"],
    edges: Int64[Tensor, "E 2"],
) -> Bool[Tensor, " V"]:
    """Moved vertices of what is no lid: once it is open photos agree no better, or silhouettes show what is gone.

    Where little is textured photos agree by chance at some depth, seen through a lid that is none: a plain wall, behind
    which nobody would see what agreed.

    Args:
        photos: which look.
        before: first hits of each, when nothing had moved.
        score: (V,) how far they agreed then (`surface_agreement`).
        moved: (V, 3).
        faces: (F, 3).
        far: (V,) how far.
        deep: (V,) which have.
        edges: (E, 2).
    """
    after = [first_hits(photo, moved, faces) for photo in photos]
    seeing = seen_by(photos, after, moved, pixel_size(photos))
    shown = surface_agreement(photos, seeing, moved, faces, edges)
    count, lid = connected(edges[deep[edges].all(dim=1)], len(deep))
    agreement, closed = (_means(torch.where(deep, each, torch.nan), lid, count)[0] for each in (shown, score))
    own = torch.where(deep, lid, -1)[faces].amax(dim=1)
    seen, lost = torch.zeros(count), torch.zeros(count)
    for photo, (_, was), (_, hit) in zip(photos, before, after, strict=True):
        of = torch.where(was >= 0, own[was.clamp_min(0)], -1)
        seen += of[of >= 0].bincount(minlength=count)
        lost += of[(of >= 0) & (hit < 0) & (photo.pixels[0, 3] > 0.95)].bincount(minlength=count)
    way, _ = _means(torch.where(deep, far, torch.nan), lid, count)
    least = torch.where(way > _FAR, closed + _GAIN, 0.0).clamp_min(_CONFIRMED)
    return deep & (agreement - _LOST * lost / seen.clamp_min(1) < least)[lid]


def _without_shafts(depth: Int64[Tensor, " N"], edges: Int64[Tensor, "E 2"], edge: float) -> Int64[Tensor, " N"]:
    """The depths, where what is deeper than any level is no deeper below it than the same limit allows."""
    for level in range(int(depth.max()), 1, -1):
        deep = depth >= level
        count, shaft = connected(edges[deep[edges].all(dim=1)], len(depth))
        width = edge * torch.zeros(count).index_add(0, shaft, deep.float()).sqrt()
        deepest = torch.zeros(count).scatter_reduce(0, shaft, depth.float(), "amax")
        depth = torch.where(deep & (deepest - level > _SLENDER * width)[shaft], level, depth)
    return depth


def _without_unseen(way: Tensor, seen: Bool[Tensor, "B N"], neighbours: Tensor, edges: Tensor) -> Tensor:
    """How far lids go in, and between those that photos see, where others would be out of sight.

    Photos that agree where they cannot see the surface show something else.

    Args:
        way: (N,) of each vertex of the lids.
        seen: by which photos, if it goes so far.
        neighbours: (N,) how many each has, on its lid or beside.
        edges: (E, 2) of the lids.
    """
    doubtful = (way > 0) & (seen.sum(dim=0) < 2)
    source, target = torch.cat([edges, edges.flip(1)]).T
    way = torch.where(doubtful, 0.0, way)
    for _ in range(_SMOOTH_UNSEEN if bool(doubtful.any()) else 0):
        mean = torch.zeros_like(way).index_add(0, target, way[source]) / neighbours
        way = torch.where(doubtful, mean, way)
    return way
