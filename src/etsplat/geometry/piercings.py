"""Where edges of a mesh pierce its faces, and on which side of a face an edge that pierces it ought to be."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from etsplat import _native
from etsplat.geometry.topology import MeshTopology, connected

_TURNED = [[0.83, -0.31, 0.47], [0.29, 0.91, -0.17], [-0.41, 0.23, 0.87]]
_TURN = torch.linalg.qr(torch.tensor(_TURNED, dtype=torch.float32, device="cpu").double()).Q
"""Some rotation: rays are cast along its first axis, since meshes often have edges in planes of the coordinate axes."""


@dataclass(frozen=True)
class Piercings:
    """P edges that pierce faces, each pair once, in ascending order.

    Attributes:
        edges: (P,) rows of the topology's edges.
        faces: (P,) the face that each pierces.
        weights: (P, 3) where it does, as weights of the face's corners; positive, with sum 1.
    """

    edges: Int[Tensor, " P"]
    faces: Int[Tensor, " P"]
    weights: Float[Tensor, "P 3"]


def find_piercings(vertices: Float[Tensor, "V 3"], topology: MeshTopology, marked: Bool[Tensor, " F"]) -> Piercings:
    """The edges of marked faces that pierce marked faces with which they share no corner.

    Args:
        vertices: (V, 3) float64 on the CPU.
        topology: of the mesh, on the CPU.
        marked: (F,) faces that intersect others, as of `intersecting_faces`.
    """
    chosen = marked.nonzero()[:, 0]
    first, second = (chosen[each] for each in overlapping_boxes(vertices[topology.faces[chosen]]))
    edges = torch.cat([topology.face_edges[first], topology.face_edges[second]]).reshape(-1)
    faces = torch.cat([second, first]).repeat_interleave(3)
    near = _boxes_meet(vertices[topology.edges[edges]], vertices[topology.faces[faces]])
    edges, faces = edges[near], faces[near]
    both = torch.unique(edges * topology.num_faces + faces)
    edges, faces = both // max(topology.num_faces, 1), both % max(topology.num_faces, 1)
    ends, corners = topology.edges[edges], topology.faces[faces]
    apart = (ends[:, :, None] != corners[:, None, :]).all(dim=2).all(dim=1)
    edges, faces = edges[apart], faces[apart]
    (p, q), (a, b, c) = vertices[ends[apart]].unbind(1), vertices[corners[apart]].unbind(1)
    weights = torch.stack([_volume(p, q, b, c), _volume(p, q, c, a), _volume(p, q, a, b)], dim=1)
    through = (_volume(a, b, c, p) * _volume(a, b, c, q) < 0) & ((weights > 0).all(dim=1) | (weights < 0).all(dim=1))
    weights = weights[through]
    return Piercings(edges[through], faces[through], weights / weights.sum(dim=1, keepdim=True))


def outer_windings(vertices: Float[Tensor, "V 3"], topology: MeshTopology, found: Piercings) -> Int[Tensor, " P"]:
    """How often the mesh winds around what lies outside both sheets that cross, just beside each piercing.

    Two oriented sheets that cross part space into four: outside of both, with winding number k, inside of one, with
    k + 1, and inside of both, with k + 2. At k = 0 two parts of a solid overlap; at k = -1 one is thinner than nothing:
    its front has gone behind its back. Found by counting faces along a ray, so that it depends on the whole surface
    and not on how it looks from here. The edges must be of two faces; others count as if they went straight on. An open
    mesh counts as closed by cones over its borders.

    Args:
        vertices: (V, 3) float64 on the CPU.
        topology: of the mesh, on the CPU.
        found: from `find_piercings`.
    """
    offsets = topology.edge_face_offsets
    first = topology.edge_faces[offsets[found.edges]]
    last = topology.edge_faces[offsets[found.edges + 1] - 1]
    points = (vertices[topology.faces[found.faces]] * found.weights[:, :, None]).sum(dim=1) @ _TURN
    beside = vertices[topology.faces[last]].mean(dim=1) - vertices[topology.edges[found.edges, 0]]
    own = torch.stack([found.faces, first, last], dim=1)
    normals = unit_normals(vertices, topology.faces[own])
    convex = (beside * normals[:, 1]).sum(dim=1) < 0
    in_face, in_first, in_last = (normals @ _TURN[:, 0] < 0).unbind(dim=1)
    in_edge = torch.where(convex, in_first & in_last, in_first | in_last)
    return _crossings(points, _closed(vertices @ _TURN, topology), own) - in_face.long() - in_edge.long()


def unit_normals(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "*F 3"]) -> Float[Tensor, "*F 3"]:
    """Of length 1, or 0 where a face has no area."""
    a, b, c = vertices[faces].unbind(-2)
    return normalize(torch.linalg.cross(b - a, c - a), dim=-1, eps=1e-30)


def winding_numbers(
    points: Float[Tensor, "P 3"], vertices: Float[Tensor, "V 3"], topology: MeshTopology
) -> Int[Tensor, " P"]:
    """How often a mesh winds around points that do not lie on it; an open one with cones over its borders.

    Args:
        points: (P, 3) float64 on the CPU.
        vertices: (V, 3) float64 on the CPU.
        topology: of the mesh, on the CPU.
    """
    none = torch.full((len(points), 1), -1)
    return _crossings(points @ _TURN, _closed(vertices @ _TURN, topology), none)


def overlapping_boxes(corners: Float[Tensor, "F 3 3"]) -> tuple[Int[Tensor, " N"], Int[Tensor, " N"]]:
    """Pairs of faces whose boxes overlap, each once, in an order that depends on these faces alone.

    Args:
        corners: float64 on the CPU, finite.
    """
    count = len(corners)
    if count == 0:
        return torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.int64)
    tree = _native.face_tree(vertices=corners.reshape(-1, 3), faces=torch.arange(3 * count).reshape(-1, 3))
    first, second = torch.from_numpy(_native.overlapping_boxes(tree=tree)).unbind(1)
    return first, second


def _closed(vertices: Float[Tensor, "V 3"], topology: MeshTopology) -> tuple[Float[Tensor, "W 3"], Int[Tensor, "G 3"]]:
    """The mesh, and behind its faces those of a cone over each border, with its tip in the middle of it."""
    alone = topology.edge_face_counts == 1
    if not bool(alone.any()):
        return vertices, topology.faces
    at_border = alone[topology.face_edges]
    tail, head = topology.faces[at_border].long(), topology.faces.roll(-1, dims=1)[at_border].long()
    _, loop = connected(torch.stack([tail, head], dim=1), len(vertices))
    ends, own = torch.cat([tail, head]), torch.cat([loop[tail], loop[head]])
    sums = torch.zeros_like(vertices).index_add_(0, own, vertices[ends])
    tips = sums / own.bincount(minlength=len(vertices)).clamp(min=1)[:, None]
    cones = torch.stack([head, tail, len(vertices) + loop[tail]], dim=1)
    return torch.cat([vertices, tips]), torch.cat([topology.faces, cones])


def _boxes_meet(first: Float[Tensor, "N K 3"], second: Float[Tensor, "N L 3"]) -> Bool[Tensor, " N"]:
    """Whether the boxes of each two sets of points overlap."""
    low = first.amin(dim=1) <= second.amax(dim=1)
    high = first.amax(dim=1) >= second.amin(dim=1)
    return (low & high).all(dim=1)


def _volume(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> Float[Tensor, " P"]:
    """Six times the signed volume of tetrahedra."""
    return ((b - a) * torch.linalg.cross(c - a, d - a)).sum(dim=1)


def _crossings(
    points: Float[Tensor, "P 3"], mesh: tuple[Float[Tensor, "V 3"], Int[Tensor, "F 3"]], own: Int[Tensor, "P K"]
) -> Int[Tensor, " P"]:
    """How many faces a ray along +x leaves through less those it enters through, but for each point's own faces."""
    vertices, faces = mesh
    counts = torch.zeros(len(points), dtype=torch.int64)
    _native.count_crossings(
        points=points.contiguous(), own=own.contiguous(), vertices=vertices, faces=faces.contiguous(), counts=counts
    )
    return counts
