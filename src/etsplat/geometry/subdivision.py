"""Longest-edge subdivision of the largest faces (paper, appendix Adaptive Refinement), as a plan.

A plan says where new vertices lie and which faces replace which; it moves no parameter. `optim/edit.py` carries it out.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from etsplat import _native
from etsplat.core.validation import check_count, check_kind, check_shape
from etsplat.geometry.topology import MeshTopology


@dataclass(frozen=True)
class SubdivisionPlan:
    """How a mesh with V vertices and F faces becomes one with V + M vertices and F' faces.

    Attributes:
        num_vertices: V.
        num_faces: F.
        new_vertices: (M, 2) the two ends of each split edge; vertex V + i is the midpoint of row i. The V old vertices
            keep their places.
        faces: (F', 3). Row f < F is face f, or its first half if it is split; the second halves follow, ascending.
        parent_face: (F',) the old face that each new face is or is half of.
    """

    num_vertices: int
    num_faces: int
    new_vertices: Int[Tensor, "M 2"]
    faces: Int[Tensor, "F_new 3"]
    parent_face: Int[Tensor, " F_new"]

    @property
    def is_empty(self) -> bool:
        """Nothing is split."""
        return len(self.new_vertices) == 0

    def interpolate(self, values: Float[Tensor, " V *rest"]) -> Float[Tensor, " V_new *rest"]:
        """Values per old vertex, followed by the means of the two ends for each new one."""
        if len(values) != self.num_vertices:
            raise ValueError(f"values must have a row for each of {self.num_vertices} vertices, got {len(values)}")
        first, second = self.new_vertices.to(values.device).unbind(1)
        return torch.cat([values, 0.5 * (values[first] + values[second])])

    def inherit(self, values: Shaped[Tensor, " F *rest"]) -> Shaped[Tensor, " F_new *rest"]:
        """Values per old face, copied to the faces that replace it."""
        if len(values) != self.num_faces:
            raise ValueError(f"values must have a row for each of {self.num_faces} faces, got {len(values)}")
        return values[self.parent_face.to(values.device)]


def longest_edge_plan(
    vertices: Float[Tensor, "V 3"], topology: MeshTopology, scores: Float[Tensor, " F"], budget_faces: int
) -> SubdivisionPlan:
    """Splits the best-scored faces at the midpoint of their longest edge, together with the faces across that edge.

    Faces are taken by descending score. Each splits its longest edge, and with it every face around that edge (two
    become four on a closed manifold, one becomes two on a boundary), so the mesh stays conforming, closed and oriented
    where it was. A face is split at most once per plan: a face whose neighbour has already been split waits for the
    next plan. Selection ends where the next split would exceed the budget. Equal scores go by face index and equal
    lengths by edge index, so that the plan depends on nothing but its arguments.

    Args:
        vertices: (V, 3), used for the edge lengths (float64 arithmetic).
        topology: connectivity of the mesh.
        scores: (F,) finite; the paper's are the face areas.
        budget_faces: most faces that the subdivided mesh may have. At or below F, the plan is empty.

    Raises:
        ValueError: a shape does not fit the topology, a score is not finite, or the budget is no whole number.

    Example:
        >>> vertices, faces = etsplat.icosphere(0)
        >>> topology = etsplat.MeshTopology.from_faces(faces, len(vertices))
        >>> plan = etsplat.longest_edge_plan(vertices, topology, scores=torch.ones(20), budget_faces=30)
        >>> len(plan.faces)
        30
    """
    _check(vertices, topology, scores)
    budget_faces = check_count("budget_faces", budget_faces, least=0)
    order = torch.sort(scores.detach().cpu(), descending=True, stable=True).indices
    longest = _longest_edges(vertices.detach().cpu().double(), topology)
    split_edge = torch.full((topology.num_faces,), -1, dtype=torch.int64)
    _native.select_edge_splits(
        order=order,
        longest_edge=longest,
        edge_face_offsets=topology.edge_face_offsets,
        edge_faces=topology.edge_faces,
        split_edge=split_edge,
        max_new_faces=budget_faces - topology.num_faces,
    )
    return _plan(topology, split_edge)


def _check(vertices: Tensor, topology: MeshTopology, scores: Tensor) -> None:
    check_kind("topology", topology, MeshTopology, "pass MeshTopology.from_faces(faces, num_vertices)")
    check_shape("vertices", vertices, (topology.num_vertices, 3))
    check_shape("scores", scores, (topology.num_faces,))
    if not bool(scores.isfinite().all()):
        raise ValueError("scores must be finite, got NaN or infinity: are the vertices finite?")


def _longest_edges(vertices: Float[Tensor, "V 3"], topology: MeshTopology) -> Int[Tensor, " F"]:
    """The longest edge of each face; of equally long ones the smallest index, so that neighbours agree."""
    ends = vertices[topology.edges]
    squared = (ends[:, 0] - ends[:, 1]).square().sum(dim=1)
    edges = topology.face_edges.sort(dim=1).values
    best = edges[:, 0]
    for k in (1, 2):
        best = torch.where(squared[edges[:, k]] > squared[best], edges[:, k], best)
    return best.contiguous()


def _plan(topology: MeshTopology, split_edge: Int[Tensor, " F"]) -> SubdivisionPlan:
    parents = torch.nonzero(split_edge >= 0)[:, 0]
    edges, rank = torch.unique(split_edge[parents], return_inverse=True)
    midpoints = topology.num_vertices + rank
    # The split edge runs from corner k to k + 1. The first half keeps corner k and moves k + 1 to the midpoint, the
    # second half the other way round: every child keeps its parent's orientation and corner order.
    corner = (topology.face_edges[parents] == split_edge[parents, None]).int().argmax(dim=1)
    faces = topology.faces.clone()
    second = faces[parents]
    second[torch.arange(len(parents)), corner] = midpoints
    faces[parents, (corner + 1) % 3] = midpoints
    return SubdivisionPlan(
        num_vertices=topology.num_vertices,
        num_faces=topology.num_faces,
        new_vertices=topology.edges[edges],
        faces=torch.cat([faces, second]),
        parent_face=torch.cat([torch.arange(topology.num_faces), parents]),
    )
