"""Edges turned to the other diagonal of their two faces, where that makes faces less slender."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from etsplat import _native
from etsplat.core.validation import check_shape
from etsplat.geometry.topology import MeshTopology

_FLAT = 0.9
"""Least cosine between the two faces of an edge that is flipped, and between each of the two before and after."""

_ROUNDS = 5
"""Over all edges: a flip can make one of its neighbours' worth it. The last finds few."""


def flipped(vertices: Float[Tensor, "V 3"], topology: MeshTopology) -> Int[Tensor, "F 3"]:
    """The faces with edges flipped until they are a Delaunay triangulation where the surface is flat, or nearly.

    An edge is flipped where the two angles opposite to it make more than half a circle. Two faces take the rows of its
    two, so what belongs to faces stays where it was, or nearly. A mesh that is closed, manifold and oriented remains
    so, with as many parts and holes. Edges stay that have one face, more than two, or two that do not agree which side
    is out, and those of vertices with three edges. Arithmetic is float64 and serial: the same for the same input.

    Args:
        vertices: (V, 3), finite.
        topology: connectivity of the mesh, on the CPU.

    Raises:
        ValueError: another number of vertices.
    """
    check_shape("vertices", vertices, (topology.num_vertices, 3))
    faces, face_edges = topology.faces.clone(), topology.face_edges.clone()
    _native.flip_edges(
        vertices=vertices.detach().double().contiguous(),
        edges=topology.edges.clone(),
        edge_faces=_turnable(topology),
        face_edges=face_edges,
        faces=faces,
        valences=topology.neighbor_offsets.diff(),
        least_cosine=_FLAT,
        rounds=_ROUNDS,
    )
    return faces


def _turnable(topology: MeshTopology) -> Int[Tensor, "E 2"]:
    """The two faces of each edge, or -1 and -1 for one that stays."""
    counts = topology.edge_face_counts
    forward = topology.faces < topology.faces.roll(-1, dims=1)
    along = torch.bincount(topology.face_edges[forward], minlength=len(topology.edges))
    chosen = (counts == 2) & (along == 1)
    found = torch.full((len(topology.edges), 2), -1)
    first = topology.edge_face_offsets[:-1][chosen]
    found[chosen] = torch.stack([topology.edge_faces[first], topology.edge_faces[first + 1]], dim=1)
    return found
