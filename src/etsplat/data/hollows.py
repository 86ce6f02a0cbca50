"""Hollows that no silhouette shows: a visual hull lies over them like a lid, and is pushed in to where photos agree.

Where the hull is the surface, the photos agree on what they show there; on a lid they do not. What is behind a lid is
seen by those photos whose line of sight enters the hull through a lid, since all the rest of the hull is the object
itself. With only these asked, they agree where the bottom of the hollow is, and hardly anywhere else.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn.functional import grid_sample, max_pool2d, normalize

from etsplat.core.cameras import camera_centers
from etsplat.data.dataset import Dataset
from etsplat.data.pictures import as_float
from etsplat.data.visual_hull import Distance, outside_hull
from etsplat.geometry.measures import vertex_normals
from etsplat.geometry.subdivision import longest_edge_plan
from etsplat.geometry.topology import MeshTopology, connected
from etsplat.ops.rasterize_opaque import rasterize_opaque

_WIDEST = 320
"""Photos are halved until none is wider: agreement asks for texture, not for detail."""

_PATCH = 7
"""Pixels across the patches that are compared."""

_STEP = 1.5
"""Pixels between two depths that are tried: an agreement is about three wide."""

_DEEPEST = 1.5
"""Depths end here, in units of the object's radius."""

_ASKED = 12
"""At most so many photos are compared at a point: those that look at it most squarely."""

_SLANT = 0.2
"""Cosine of the angle to the normal, below which a photo is not asked."""

_AGREED = 0.75
"""Correlation of photos that show one surface; those of different ones have about 0.3."""

_FLAT = 0.01
"""Standard deviation of colours below which a patch shows nothing to compare."""

_UNKNOWN = 0.6
"""Cost of a depth where nobody can be asked; elsewhere it is 1 - agreement."""

_BEND, _TEAR = 0.03, 0.3
"""Cost of an edge for each step that its ends differ, and its bound."""

_ROUNDS = 30
"""Of belief propagation."""

_SMOOTH, _SMOOTH_LID = 3, 20
"""Rounds in which normals of the hull, and of lids by themselves, are averaged with their neighbours'."""

_SLENDER = 2.0
"""Hollows are at most so many times as deep as they are wide."""

_SMOOTH_UNSEEN = 100
"""Rounds in which what no two photos see comes between its neighbours."""

_PASSES = 3
"""Looks at all lids: the second sees walls where the first tore."""

_LONGEST = 2.5
"""Edges longer than this times the mean of the hull's are divided."""

_FEWEST = 8
"""Vertices of a lid that is worth moving."""


@dataclass(frozen=True)
class _Photo:
    """A photo with its camera: (1, 4, H, W) pixels, (4, 4), (3, 3) and (3,)."""

    pixels: Tensor
    viewmat: Tensor
    K: Tensor
    center: Tensor

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """(..., 2) places as `grid_sample` has them, and (...) depths, of (..., 3) points."""
        camera = points @ self.viewmat[:3, :3].T + self.viewmat[:3, 3]
        z = camera[..., 2]
        height, width = self.pixels.shape[2:]
        pixel = (camera @ self.K.T)[..., :2] / torch.where(z > 0, z, 1.0)[..., None]
        place = 2 * pixel / torch.tensor([width, height]) - 1
        return torch.where(z[..., None] > 0, place, 2.0), z

    def look_up(self, planes: Tensor, places: Tensor, mode: str = "bilinear") -> Tensor:
        """(C, N, M) values of (1, C, H, W) planes at (N, M, 2) places; 0 outside."""
        return grid_sample(planes, places[None], mode=mode, align_corners=False)[0]


@torch.no_grad()
def open_hollows(
    dataset: Dataset, vertices: Float[Tensor, "V 3"], faces: Int64[Tensor, "F 3"]
) -> tuple[Float[Tensor, "V2 3"], Int64[Tensor, "F2 3"], int]:
    """Pushes lids of the visual hull in to where the training views agree.

    Agreement is the normalised cross-correlation of patches of the photos, so exposure does not matter; where there is
    no texture nothing moves. Depths along a lid's normal are chosen by belief propagation, smooth but for tears at the
    walls. Lids under which the photos do not agree either stay. What was stretched into walls is divided, and looked at
    again.

    Args:
        dataset: photos with alpha around an object in the unit ball.
        vertices: (V, 3) of the hull, from `visual_hull`.
        faces: (F, 3) of it.

    Returns:
        Vertices (V2, 3), faces (F2, 3), at most half as many again, and how many vertices moved.
    """
    while max(dataset.images.sizes[index][0] for index in dataset.train) > _WIDEST:
        dataset = dataset.halved()
    photos = _photos(dataset)
    if len(photos) < 2 or len(vertices) == 0:
        return vertices, faces, 0
    edge, most = float(_edge_lengths(vertices, faces).mean()), len(faces) * 3 // 2
    outside, total = outside_hull(dataset), 0
    for _ in range(_PASSES):
        vertices, moved = _push(photos, outside, vertices, faces)
        if moved == 0:
            break
        total += moved
        vertices, faces = _divided(vertices, faces, _LONGEST * edge, most)
    return vertices, faces, total


def _push(photos: list[_Photo], outside: Distance, vertices: Tensor, faces: Tensor) -> tuple[Tensor, int]:
    """Moved vertices, and how many: one look at all lids."""
    edges = MeshTopology.from_faces(faces, len(vertices)).edges.long()
    distance = torch.stack([photo.center.norm() for photo in photos]).mean()
    pixel = float(distance / photos[0].K[0, 0])
    hits = [_first_hits(photo, vertices, faces) for photo in photos]

    raw = vertex_normals(vertices, faces)
    score = _surface_agreement(photos, hits, vertices, _averaged(raw, edges, _SMOOTH), pixel)
    lid = _ring_mean(score, edges) < _AGREED
    own = lid.nonzero()[:, 0]
    if len(own) < _FEWEST:
        return vertices, 0
    number = torch.full((len(vertices),), -1)
    number[own] = torch.arange(len(own))
    links = number[edges[lid[edges].all(dim=1)]]

    inward = -_averaged(raw[own], links, _SMOOTH_LID)
    depths = _STEP * pixel * torch.arange(int(_DEEPEST / (_STEP * pixel)) + 1)
    lids = [((hit >= 0) & (lid[faces].sum(dim=1) >= 2)[hit.clamp_min(0)]).float()[None, None] for _, hit in hits]
    free = _within(outside, vertices[own], inward, depths)
    found = torch.full(free.shape, torch.nan)
    for number, depth in enumerate(depths):
        within = free[:, number]
        points = vertices[own][within] + depth * inward[within]
        found[within, number] = _agreement_behind(photos, lids, points, -inward[within], pixel)
    cost = torch.where(found.isnan(), _UNKNOWN, 1 - found.clamp(0, 1)).masked_fill(~free, torch.inf)
    depth = _depths(cost, links)
    edge = float((vertices[edges[:, 0]] - vertices[edges[:, 1]]).norm(dim=1).mean())
    depth = _where_agreed(depth, found, links, edge / float(depths[1]))
    way, moved = depths[depth], vertices.clone()
    moved[own] += way[:, None] * inward
    seen = _seen(photos, [_first_hits(photo, moved, faces) for photo in photos], moved[own], pixel)
    way = _without_unseen(way, seen, edges.flatten().bincount(minlength=len(vertices))[own], links)
    moved[own] = vertices[own] + way[:, None] * inward
    return moved, int((way > depths[1]).sum())


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


def _photos(dataset: Dataset) -> list[_Photo]:
    viewmats, Ks = dataset.viewmats[dataset.train].float(), dataset.Ks[dataset.train].float()
    pixels = [as_float(dataset.images[index]).permute(2, 0, 1)[None] for index in dataset.train]
    return [_Photo(*each) for each in zip(pixels, viewmats, Ks, camera_centers(viewmats), strict=True)]


def _first_hits(photo: _Photo, vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """(H, W) depth of the surface at each pixel, 0 where there is none, and (H, W) its face, else -1."""
    height, width = photo.pixels.shape[2:]
    drawn = rasterize_opaque(
        vertices, faces=faces, viewmats=photo.viewmat[None], Ks=photo.K[None], width=width, height=height
    )
    assert drawn.triangle is not None
    assert drawn.depth is not None
    triangle = drawn.triangle[0].long()
    return torch.where(triangle >= 0, drawn.depth[0, ..., 0], 0.0), triangle


def _surface_agreement(
    photos: list[_Photo], hits: list[tuple[Tensor, Tensor]], points: Tensor, normals: Tensor, pixel: float
) -> Tensor:
    """(V,) how far photos agree at points of the surface that they see."""
    masks = [(photo.pixels[:, 3:] >= 0.95).float() for photo in photos]
    return _agreement(photos, masks, points, normals, _seen(photos, hits, points, pixel), pixel, fewest=3)


def _seen(photos: list[_Photo], hits: list[tuple[Tensor, Tensor]], points: Tensor, pixel: float) -> Bool[Tensor, "B V"]:
    """Which photos see which points of the surface."""
    seen = []
    for photo, (depth, _) in zip(photos, hits, strict=True):
        place, z = photo.project(points)
        around = max_pool2d(depth[None, None], 3, stride=1, padding=1)
        seen.append(z <= photo.look_up(around, place[None], "nearest")[0, 0] + 1.5 * pixel)
    return torch.stack(seen)


def _agreement_behind(
    photos: list[_Photo], lids: list[Tensor], points: Tensor, normals: Tensor, pixel: float
) -> Tensor:
    """(N,) how far photos agree at points that they see through lids, which are masks (1, 1, H, W)."""
    seen = torch.stack(
        [
            photo.look_up(lid, photo.project(points)[0][None], "nearest")[0, 0] > 0.5
            for photo, lid in zip(photos, lids, strict=True)
        ]
    )
    enough = seen.sum(dim=0) >= 2
    found = torch.full((len(points),), torch.nan)
    found[enough] = _agreement(photos, lids, points[enough], normals[enough], seen[:, enough], pixel, fewest=2)
    return found


def _agreement(
    photos: list[_Photo],
    masks: list[Tensor],
    points: Float[Tensor, "N 3"],
    normals: Float[Tensor, "N 3"],
    seen: Bool[Tensor, "B N"],
    pixel: float,
    *,
    fewest: int,
) -> Float[Tensor, " N"]:
    """Mean of the upper half of the correlations between the photos that see each point; NaN if too few do."""
    directions = normalize(torch.stack([photo.center for photo in photos])[:, None] - points, dim=2)
    square = torch.where(seen, (directions * normals).sum(dim=2), -1.0)
    cosine, asked = square.topk(min(_ASKED, len(photos)), dim=0)
    patch = _patches(points, normals, pixel)
    colors = torch.zeros(len(points), len(asked), patch.shape[1], 3)
    valid = torch.zeros(*colors.shape[:3])
    for index, photo in enumerate(photos):
        rank, who = ((asked == index) & (cosine > _SLANT)).nonzero(as_tuple=True)
        place = photo.project(patch[who])[0]
        colors[who, rank] = photo.look_up(photo.pixels[:, :3], place).permute(1, 2, 0)
        valid[who, rank] = photo.look_up(masks[index], place, "nearest")[0]
    mean = (colors * valid[..., None]).sum(dim=2) / valid.sum(dim=2).clamp_min(1)[..., None]
    colors = (colors - mean[:, :, None]) * valid[..., None]
    length = colors.square().sum(dim=(2, 3)).sqrt()
    shows = (valid.mean(dim=2) > 0.7) & (length > _FLAT * (3 * patch.shape[1]) ** 0.5)
    unit = (colors / length.clamp_min(1e-6)[..., None, None]).flatten(2)
    first, second = torch.triu_indices(len(asked), len(asked), 1)
    both = shows[:, first] & shows[:, second]
    ranked = torch.where(both, (unit @ unit.mT)[:, first, second], -torch.inf).sort(dim=1, descending=True).values
    half = (both.sum(dim=1) + 1) // 2
    kept = torch.where(torch.arange(ranked.shape[1]) < half[:, None], ranked, 0.0).sum(dim=1)
    return torch.where(shows.sum(dim=1) >= fewest, kept / half, torch.nan)


def _patches(points: Tensor, normals: Tensor, pixel: float) -> Tensor:
    """(N, P, 3) grids of points across the normals, a pixel apart."""
    across = torch.where(normals[:, :1].abs() < 0.7, torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 1.0, 0.0]))
    u = normalize(torch.linalg.cross(normals, across), dim=1)
    v = torch.linalg.cross(normals, u)
    steps = pixel * (torch.arange(_PATCH) - (_PATCH - 1) / 2)
    y, x = torch.meshgrid(steps, steps, indexing="ij")
    return points[:, None] + x.reshape(-1, 1) * u[:, None] + y.reshape(-1, 1) * v[:, None]


def _within(outside: Distance, points: Tensor, inward: Tensor, depths: Tensor) -> Bool[Tensor, "N D"]:
    """Which depths lie before the way inwards comes within a step of the hull's other side."""
    beyond = torch.stack([outside(points + depth * inward) > -depths[1] for depth in depths[2:]], dim=1)
    free = beyond.int().cumsum(dim=1) == 0
    # A lid itself, and the way to the first depth well inside of it, are always free.
    return torch.cat([torch.ones(len(points), 2, dtype=torch.bool), free], dim=1)


def _depths(cost: Float[Tensor, "N D"], edges: Int64[Tensor, "E 2"]) -> Int64[Tensor, " N"]:
    """The depths of least cost with that of the edges, by min-sum belief propagation with a truncated linear cost."""
    source, target = torch.cat([edges, edges.flip(1)]).T
    back = torch.arange(len(source)).roll(len(edges))
    message = torch.zeros(len(source), cost.shape[1])

    def belief() -> Tensor:
        return cost.index_add(0, target, message)

    for _ in range(_ROUNDS):
        sent = belief()[source] - message[back]
        least = sent.amin(dim=1, keepdim=True)
        for order in (range(1, cost.shape[1]), range(cost.shape[1] - 2, -1, -1)):
            for k in order:
                behind = k - 1 if order.step > 0 else k + 1
                torch.minimum(sent[:, k], sent[:, behind] + _BEND, out=sent[:, k])
        sent = torch.minimum(sent, least + _TEAR)
        message = (message + sent - sent.amin(dim=1, keepdim=True)) / 2
    return belief().argmin(dim=1)


def _where_agreed(depth: Tensor, found: Tensor, edges: Tensor, edge: float) -> Tensor:
    """The depths, 0 for lids under which photos agree no more than on a lid, and for those that hardly move.

    Hollows much deeper than wide are no hollows: no two photos could see their bottom. The length of an edge, by which
    widths are known, is given in depths.
    """
    at = found.gather(1, depth[:, None])[:, 0]
    deep = depth > 1
    count, lid = connected(edges[deep[edges].all(dim=1)], len(depth))
    size = torch.zeros(count).index_add(0, lid, deep.float())
    known = ~at.isnan()
    asked = torch.zeros(count).index_add(0, lid, known.float())
    agreement = torch.zeros(count).index_add(0, lid, at.nan_to_num()) / asked.clamp_min(1)
    deepest = torch.zeros(count).scatter_reduce(0, lid, depth.float(), "amax")
    opened = (size >= _FEWEST) & (2 * asked >= size) & (agreement >= _AGREED)
    opened &= deepest <= _SLENDER * edge * size.sqrt()
    return torch.where(deep & opened[lid], depth, 0)


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


def _averaged(normals: Tensor, edges: Tensor, rounds: int) -> Tensor:
    source, target = torch.cat([edges, edges.flip(1)]).T
    for _ in range(rounds):
        normals = normalize(normals.index_add(0, target, normals[source]), dim=1)
    return normals


def _ring_mean(values: Tensor, edges: Tensor) -> Tensor:
    """(V,) the mean over a vertex and its neighbours of what is not NaN."""
    source, target = torch.cat([edges, edges.flip(1)]).T
    known, value = (~values.isnan()).float(), values.nan_to_num()
    return value.index_add(0, target, value[source]) / known.index_add(0, target, known[source])
