"""Short loops on closed surfaces that go around a handle or through a hole."""

import numpy as np
import torch
from jaxtyping import Float, Int64
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra, minimum_spanning_tree
from torch import Tensor

from etsplat.geometry.parts import face_parts
from etsplat.geometry.topology import MeshTopology

_GENERATIONS = 3
"""Loops are sought from the first vertex of each part, and then from where those that were found are."""

_MOST = 40
"""From so many vertices at most, in each generation."""


def short_loops(vertices: Float[Tensor, "V 3"], faces: Int64[Tensor, "F 3"]) -> list[list[int]]:
    """Loops of edges that bound no disc, the shortest first: of each handle some around it, some through its hole.

    From a vertex the shortest ways to all others are a tree. Of the other edges, a tree of faces is joined across
    those whose ways are longest; two for each handle are left, and with their ways they are loops (Erickson and
    Whittlesey 2005).

    Args:
        vertices: (V, 3).
        faces: (F, 3), a closed manifold.
    """
    topology = MeshTopology.from_faces(faces, len(vertices))
    edges = topology.edges.long()
    length = (vertices[edges[:, 0]] - vertices[edges[:, 1]]).norm(dim=1).double()
    part = face_parts(faces, len(vertices))
    roots = [int(faces[part == number][0, 0]) for number in range(int(part.max()) + 1)]
    asked, found = set(), {}
    for _ in range(_GENERATIONS):
        loops = [loop for root in roots for loop in _loops_through(root, topology, edges, length)]
        asked.update(roots)
        new = {frozenset(loop): loop for loop in loops if frozenset(loop) not in found}
        found |= new
        there = dict.fromkeys(place for loop in new.values() for place in (loop[0], loop[len(loop) // 2]))
        roots = [place for place in there if place not in asked][:_MOST]

    def around(loop: list[int]) -> float:
        places = vertices[loop]
        return float((places - places.roll(1, dims=0)).norm(dim=1).sum())

    return sorted(found.values(), key=around)


def _loops_through(root: int, topology: MeshTopology, edges: Tensor, length: Tensor) -> list[list[int]]:
    """Two loops for each handle of the part that a vertex is in: there and back by the shortest ways from it."""
    V, F = topology.num_vertices, topology.num_faces
    a, b = edges.T
    way, before = dijkstra(
        csr_array((length.numpy(), (a.numpy(), b.numpy())), shape=(V, V)),
        directed=False,
        indices=root,
        return_predecessors=True,
    )
    way, before = torch.from_numpy(way), torch.from_numpy(before).long()
    free = ((before[a] != b) & (before[b] != a) & (way[a] + way[b]).isfinite()).nonzero()[:, 0]
    around = (way[a] + way[b] + length)[free]
    order = free[torch.argsort(around, stable=True)]
    # Two faces may share two edges of a closed mesh: the one with the longer way joins them.
    pairs = topology.face_pairs[order].long().numpy()
    keys, earliest, which = np.unique(pairs[:, 0] * F + pairs[:, 1], return_index=True, return_inverse=True)
    latest = np.empty_like(earliest)
    latest[which] = np.arange(len(order))
    longest = order[torch.from_numpy(latest)]
    first, second = pairs[np.sort(earliest)].T
    cost = 1 + around.max() - (way[a] + way[b] + length)[longest[torch.from_numpy(np.argsort(earliest))]]
    tree = minimum_spanning_tree(csr_array((cost.numpy(), (first, second)), shape=(F, F)))
    row, column = tree.nonzero()
    left = torch.zeros(len(edges), dtype=torch.bool)
    left[free] = True
    left[longest[np.searchsorted(keys, row.astype(np.int64) * F + column)]] = False
    known = before.tolist()
    return [_closed(a, b, known) for a, b in edges[left].tolist()]


def _closed(a: int, b: int, before: list[int]) -> list[int]:
    """The loop along an edge and back by the ways of its ends, as far as these are apart."""
    there, back = _way_back(a, before), _way_back(b, before)
    while len(there) > 1 and len(back) > 1 and there[-2] == back[-2]:
        there.pop()
        back.pop()
    return there + back[-2::-1]


def _way_back(place: int, before: list[int]) -> list[int]:
    way = [place]
    while (place := before[place]) >= 0:
        way.append(place)
    return way
