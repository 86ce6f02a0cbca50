"""A film of soap: the part of a surface of which nothing is known, as small as what is around it lets it be."""

import torch
from jaxtyping import Bool, Float, Int64
from scipy.sparse.linalg import splu
from torch import Tensor

from etsplat.geometry.laplacians import laplacian
from etsplat.geometry.topology import MeshTopology, connected

_SWEEPS = 200
"""Of vertices between their neighbours."""


def film(vertices: Float[Tensor, "V 3"], faces: Int64[Tensor, "F 3"], free: Bool[Tensor, " V"]) -> Float[Tensor, "V 3"]:
    """Moves the free vertices between their neighbours until they hardly move; a slit in them closes.

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        free: (V,) which move. Where all of a part are free, it shrinks.
    """
    edges = MeshTopology.from_faces(faces, len(vertices)).edges.long()
    source, target = torch.cat([edges, edges.flip(1)]).T
    own = free.nonzero()[:, 0]
    number = torch.full((len(vertices),), -1)
    number[own] = torch.arange(len(own))
    source, target = source[free[target]], number[target[free[target]]]
    counts = target.bincount(minlength=len(own)).clamp_min(1)[:, None]
    places = vertices.clone()
    for _ in range(_SWEEPS if len(own) else 0):
        places[own] = places.new_zeros((len(own), 3)).index_add(0, target, places[source]) / counts
    return places


def tight_film(
    vertices: Float[Tensor, "V 3"], edges: Int64[Tensor, "E 2"], free: Bool[Tensor, " V"]
) -> Float[Tensor, "V 3"]:
    """Where a film comes to rest, whose sweeps in areas many edges wide would take thousands: one sparse solution.

    Args:
        vertices: (V, 3).
        edges: (E, 2) between them.
        free: (V,) which move, some at least; some vertex of each part is held.
    """
    own = free.nonzero()[:, 0].numpy()
    rows = laplacian(edges, len(free))[own]
    places = vertices.double().numpy().copy()
    held = places.copy()
    held[own] = 0
    places[own] = splu(rows[:, own].tocsc()).solve(-(rows @ held))
    return torch.from_numpy(places).to(vertices)


def slits_closed(
    vertices: Float[Tensor, "V 3"], faces: Int64[Tensor, "F 3"], free: Bool[Tensor, " V"], deepest: float
) -> Float[Tensor, "V 3"]:
    """A film at rest, but of those patches alone in which no vertex goes farther: what is deeper is a hollow, no slit.

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        free: (V,) which may move; where all of a part may, it stays.
        deepest: how far, in the units of the vertices.
    """
    edges = MeshTopology.from_faces(faces, len(vertices)).edges.long()
    free = held(free, edges)
    if not bool(free.any()):
        return vertices
    moved = tight_film(vertices, edges, free)
    count, patch = connected(edges[free[edges].all(dim=1)], len(vertices))
    farthest = torch.zeros(count).scatter_reduce(0, patch, (moved - vertices).norm(dim=1).float(), "amax")
    return torch.where((farthest <= deepest)[patch, None], moved, vertices)


def held(free: Bool[Tensor, " V"], edges: Int64[Tensor, "E 2"]) -> Bool[Tensor, " V"]:
    """The free vertices of parts of which some vertex stays: others would shrink to a point."""
    count, part = connected(edges, len(free))
    return free & (torch.zeros(count).index_add(0, part, (~free).float()) > 0)[part]
