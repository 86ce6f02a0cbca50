"""Pushing apart sheets of a mesh that cross: each piercing by the least motion that undoes it."""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from etsplat.geometry.piercings import Piercings, find_piercings, outer_windings, unit_normals
from etsplat.geometry.topology import MeshTopology

GAP = 0.03
"""How far apart sheets are to be after, in median edges."""


def separated(
    vertices: Float[Tensor, "V 3"], topology: MeshTopology, marked: Bool[Tensor, " F"]
) -> Float[Tensor, "V 3"]:
    """One round of pushing: every piercing of marked faces pulls its edge and its face to the sides they belong on.

    Which sides those are the winding number says (`outer_windings`): parts of a solid that overlap are pushed out of
    each other, and the front and back of what is thinner than nothing past each other. Of the ways to undo a piercing
    (an end of the edge moves through the face's plane, or the edge past one of the face's) the one that moves the five
    vertices least in the sense of least squares is taken, by the sheets' distance. A vertex of several
    piercings moves by the mean of what they ask.

    Args:
        vertices: (V, 3) float64 on the CPU.
        topology: of the mesh, on the CPU.
        marked: (F,) faces that intersect others.
    """
    found = find_piercings(vertices, topology, marked)
    if len(found.edges) == 0:
        return vertices
    ends = vertices[topology.edges]
    gap = GAP * float((ends[:, 0] - ends[:, 1]).norm(dim=1).median())
    moves = _least_moves(vertices, topology, found, gap)
    asked = torch.cat([topology.edges[found.edges], topology.faces[found.faces]], dim=1).reshape(-1)
    moves = moves.reshape(-1, 3)
    sums = torch.zeros_like(vertices).index_add_(0, asked, moves)
    counts = torch.zeros(len(vertices), dtype=vertices.dtype)
    counts.index_add_(0, asked, (moves != 0).any(dim=1).to(vertices.dtype))
    return vertices + sums / counts.clamp(min=1)[:, None]


def _least_moves(
    vertices: Float[Tensor, "V 3"],
    topology: MeshTopology,
    found: Piercings,
    gap: float,
) -> Float[Tensor, "P 5 3"]:
    """How the two ends of each edge and the three corners of each face are to move."""
    out = torch.where(outer_windings(vertices, topology, found) >= 0, 1.0, -1.0).to(vertices)
    (p, q), corners = vertices[topology.edges[found.edges]].unbind(1), vertices[topology.faces[found.faces]]
    normal = unit_normals(vertices, topology.faces[found.faces])
    of_edge = _edge_normals(vertices, topology, found.edges)
    of_sides = _edge_normals(vertices, topology, topology.face_edges[found.faces].reshape(-1)).view(-1, 3, 3)
    choice = _Least(len(p), vertices, gap)
    for end, x in enumerate((p, q)):
        distance = ((x - corners[:, 0]) * normal).sum(dim=1)
        weights = torch.zeros(len(p), 5).to(vertices)
        weights[:, end], weights[:, 2:] = 1, -found.weights
        choice.offer(distance.abs(), out[:, None] * normal, weights, distance * out < 0)
    for k in range(3):
        x, y = corners[:, k], corners[:, (k + 1) % 3]
        along, other, between = q - p, y - x, x - p
        across = torch.linalg.cross(along, other)
        length = across.norm(dim=1).clamp(min=1e-30)
        across = across / length[:, None]
        distance = (between * across).sum(dim=1)
        t = (torch.linalg.cross(between, other) * across).sum(dim=1) / length
        s = (torch.linalg.cross(between, along) * across).sum(dim=1) / length
        direction = distance.sign()[:, None] * across
        outwards = of_sides[:, k] - of_edge
        right = out * (direction * outwards).sum(dim=1) > 0
        weights = torch.zeros(len(p), 5).to(vertices)
        weights[:, 0], weights[:, 1] = 1 - t, t
        weights[:, 2 + k], weights[:, 2 + (k + 1) % 3] = s - 1, -s
        choice.offer(distance.abs(), direction, weights, right & (t >= 0) & (t <= 1) & (s >= 0) & (s <= 1))
    return choice.moves


class _Least:
    """Of the motions that are offered for each piercing the one whose squares sum to least; none if none is right."""

    def __init__(self, count: int, like: Tensor, gap: float) -> None:
        self.moves = torch.zeros(count, 5, 3).to(like)
        self._cost, self._gap = torch.full((count,), math.inf).to(like), gap

    def offer(
        self,
        distance: Float[Tensor, " P"],
        direction: Float[Tensor, "P 3"],
        weights: Float[Tensor, "P 5"],
        right: Bool[Tensor, " P"],
    ) -> None:
        """The weighted sum of the five vertices is to grow by a distance, and the gap, in a direction."""
        way, squares = distance + self._gap, weights.square().sum(dim=1)
        cost = way.square() / squares
        taken = right & (cost < self._cost)
        moves = (way / squares)[:, None, None] * weights[:, :, None] * direction[:, None, :]
        self.moves = torch.where(taken[:, None, None], moves, self.moves)
        self._cost = torch.where(taken, cost, self._cost)


def _edge_normals(
    vertices: Float[Tensor, "V 3"], topology: MeshTopology, edges: Int[Tensor, " N"]
) -> Float[Tensor, "N 3"]:
    """The sum of the normals of the faces around each of some edges."""
    begin, counts = topology.edge_face_offsets[edges], topology.edge_face_counts[edges]
    owner = torch.repeat_interleave(torch.arange(len(edges)), counts)
    number = torch.arange(len(owner)) - (counts.cumsum(0) - counts)[owner]
    normals = unit_normals(vertices, topology.faces[topology.edge_faces[begin[owner] + number]])
    return torch.zeros(len(edges), 3).to(vertices).index_add_(0, owner, normals)
