"""Undoing self-intersections by smoothing where they are."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from etsplat.geometry.intersections import intersecting_faces
from etsplat.geometry.topology import MeshTopology

_SWEEPS = 2
"""Smoothing sweeps between two looks for intersections: more move vertices farther than needed, fewer look longer."""

_WIDEN = 8
"""Rounds after which the region grows by a ring of neighbours."""

_STEP = 0.5
"""How far a sweep moves a vertex towards the mean of its neighbours."""


def untangle(
    vertices: Float[Tensor, "V 3"], topology: MeshTopology, *, rounds: int = 40
) -> tuple[Float[Tensor, "V 3"], int]:
    """Moves the vertices of faces that cut through others until none does, or the rounds are used up.

    Each round marks the corners of intersecting faces, adds a ring of neighbours for every eighth round already done,
    so that what resists is smoothed more widely, and moves the marked vertices to the mean of their neighbours in
    damped sweeps. All others stay where they are. Boundary vertices may shrink inwards. Computed on the CPU.

    Args:
        vertices: (V, 3) finite.
        topology: of the mesh.
        rounds: most looks for intersections.

    Returns:
        Moved vertices, and how many faces still intersect.
    """
    device, vertices = vertices.device, vertices.detach().cpu().clone()
    faces = topology.faces.cpu()
    marked = intersecting_faces(vertices, faces)
    for done in range(rounds):
        if not bool(marked.any()):
            break
        _smooth(vertices, topology, _region(marked, topology, rings=done // _WIDEN))
        marked = intersecting_faces(vertices, faces)
    return vertices.to(device), int(marked.sum())


def _region(faces: Bool[Tensor, " F"], topology: MeshTopology, rings: int) -> Bool[Tensor, " V"]:
    """The corners of some faces, and so many rings of neighbours."""
    region = torch.zeros(topology.num_vertices, dtype=torch.bool)
    region[topology.faces.cpu()[faces].reshape(-1)] = True
    first, second = topology.edges.cpu().unbind(1)
    for _ in range(rings):
        grown = region.clone()
        grown[second[region[first]]] = True
        grown[first[region[second]]] = True
        region = grown
    return region


def _smooth(vertices: Tensor, topology: MeshTopology, region: Bool[Tensor, " V"]) -> None:
    """Damped sweeps over the vertices of a region, in place."""
    counts = topology.neighbor_offsets.cpu().diff()
    owner = torch.repeat_interleave(torch.arange(topology.num_vertices), counts)
    inside = region[owner]
    owner, neighbors = owner[inside], topology.neighbor_indices.cpu()[inside]
    moved = region & (counts > 0)
    for _ in range(_SWEEPS):
        sums = torch.zeros_like(vertices).index_add_(0, owner, vertices[neighbors])
        means = sums[moved] / counts[moved, None]
        vertices[moved] += _STEP * (means - vertices[moved])
