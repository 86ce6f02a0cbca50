"""Closed surfaces that touch themselves in edges or vertices, taken apart there."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from etsplat.geometry.topology import MeshTopology, connected

_APART = 0.1
"""How far new vertices lie from an edge that was shared, towards the faces that keep them."""


def taken_apart(
    vertices: Float[Tensor, "V 3"], faces: Int64[Tensor, "F 3"]
) -> tuple[Float[Tensor, "V2 3"], Int64[Tensor, "F2 3"]]:
    """A closed, oriented mesh made a manifold.

    Where more than two faces meet in an edge, those that bound the same wedge of the inside stay together (after
    Gueziec, Taubin, Lazarus, Horn, "Converting Sets of Polygons to Manifold Surfaces by Cutting and Stitching", 1998).
    A vertex becomes one for each fan around it. An edge both of whose ends are still one is divided, once for each
    wedge.

    Args:
        vertices: (V, 3).
        faces: (F, 3), counter-clockwise seen from outside; each edge is run along as often one way as the other.

    Returns:
        Vertices, those that no face uses left out, and faces: the first F are those given, or what is left of them. A
        manifold is returned as it is.

    Raises:
        ValueError: the mesh is not closed and oriented.
    """
    topology = MeshTopology.from_faces(faces, len(vertices))
    if topology.is_manifold():
        return vertices, faces
    shared = (topology.edge_face_counts != 2)[topology.face_edges].reshape(-1)
    twin = _twins(vertices, faces, topology.face_edges.reshape(-1), shared)
    following = torch.arange(3 * len(faces)).reshape(-1, 3).roll(-1, dims=1).reshape(-1)
    _, fan = connected(torch.stack([torch.arange(len(twin)), following[twin]], dim=1), len(twin))
    first = torch.full((int(fan.max()) + 1,), len(twin)).scatter_reduce(0, fan, torch.arange(len(twin)), "amin")
    vertices, apart = vertices[faces.reshape(-1)[first]], fan.reshape(-1, 3)
    counts = MeshTopology.from_faces(apart, len(vertices))
    double = (counts.edge_face_counts > 2)[counts.face_edges].reshape(-1)
    pairs = [(half, int(twin[half])) for half in double.nonzero()[:, 0].tolist() if half < int(twin[half])]
    return _divided(vertices, apart, pairs) if pairs else (vertices, apart)


def _twins(vertices: Tensor, faces: Tensor, edge: Tensor, shared: Tensor) -> Int64[Tensor, " 3F"]:
    """For each half-edge the one that runs the other way, along the same wedge of the inside."""
    order = torch.argsort(torch.where(shared, -1, edge), stable=True)[int(shared.sum()) :]
    twin = torch.full((len(edge),), -1)
    twin[order[::2]], twin[order[1::2]] = order[1::2], order[::2]
    halves = shared.nonzero()[:, 0]
    for number in edge[halves].unique():
        for half, other in _wedges(vertices, faces, halves[edge[halves] == number].tolist()):
            twin[half], twin[other] = other, half
    tail = faces.reshape(-1)
    head = faces.roll(-1, dims=1).reshape(-1)
    if not (torch.equal(tail[twin], head) and torch.equal(head[twin], tail)):
        raise ValueError("faces: must bound a closed surface, with neighbours that agree which side is out")
    return twin


def _wedges(vertices: Tensor, faces: Tensor, halves: Sequence[int]) -> list[tuple[int, int]]:
    """Pairs of the half-edges of one edge: the inside is clockwise of a face that runs along it."""
    corners = [faces[half // 3].roll(-(half % 3)) for half in halves]
    start, end = min(corners[0][:2].tolist()), max(corners[0][:2].tolist())
    axis = torch.nn.functional.normalize(vertices[end].double() - vertices[start].double(), dim=0)
    across = torch.eye(3, dtype=torch.float64)[int(axis.abs().argmin())]
    u = torch.nn.functional.normalize(torch.linalg.cross(axis, across), dim=0)
    v = torch.linalg.cross(axis, u)
    beside = [vertices[corner[2]].double() - vertices[start].double() for corner in corners]
    angles = [math.atan2(float(side @ v), float(side @ u)) for side in beside]
    forward = [k for k, corner in enumerate(corners) if int(corner[0]) == start]
    backward = [k for k, corner in enumerate(corners) if int(corner[0]) == end]
    if len(forward) != len(backward):
        raise ValueError("faces: must bound a closed surface, with neighbours that agree which side is out")
    pairs = []
    for k in sorted(forward, key=lambda k: angles[k]):
        other = min(backward, key=lambda j: (angles[k] - angles[j]) % (2 * math.pi))
        backward.remove(other)
        pairs.append((halves[k], halves[other]))
    return pairs


def _divided(
    vertices: Tensor, faces: Tensor, pairs: Sequence[tuple[int, int]]
) -> tuple[Float[Tensor, "V2 3"], Int64[Tensor, "F2 3"]]:
    """Faces cut at the middles of some of their edges, which each pair of half-edges has for itself."""
    middles: dict[int, dict[int, int]] = {}
    added: list[Tensor] = []
    for pair in pairs:
        ends = faces[pair[0] // 3].roll(-(pair[0] % 3))[:2]
        beside = torch.stack([faces[half // 3].roll(-(half % 3))[2] for half in pair])
        middle = vertices[ends].mean(dim=0)
        for half in pair:
            middles.setdefault(half // 3, {})[half % 3] = len(vertices) + len(added)
        added.append(torch.lerp(middle, vertices[beside].mean(dim=0), _APART))
    kept, more = faces.clone(), []
    for face, cuts in middles.items():
        rest = faces[face].tolist()
        outline = [corner for k in range(3) for corner in (rest[k], cuts.get(k)) if corner is not None]
        # Ears at the new vertices, so that no triangle has all its corners on one edge.
        turn = next(k for k, corner in enumerate(outline) if corner >= len(vertices))
        outline = outline[turn:] + outline[:turn]
        fan = [[outline[0], outline[k], outline[k + 1]] for k in range(1, len(outline) - 1)]
        kept[face] = torch.tensor(fan[0])
        more += fan[1:]
    return torch.cat([vertices, torch.stack(added)]), torch.cat([kept, torch.tensor(more)])
