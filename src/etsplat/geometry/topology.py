"""Connectivity of a triangle mesh: edges, which faces share them, neighbours; and what kind of surface it is.

Everything comes from one stable sort of the 3F half-edges. Half-edge 3f + k runs from corner k to corner (k + 1) % 3
of face f; all half-edges with the same two ends are one edge, whichever way they run.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from etsplat.core.short_repr import short_repr
from etsplat.core.validation import check_indices, check_shape
from etsplat.ops.mesh_energies import MeshConnectivity


@dataclass(frozen=True, eq=False)
class MeshTopology:
    """Connectivity of a triangle mesh, int64, on the device of its faces. Build it with `from_faces`.

    Attributes:
        num_vertices: V, vertices that no face uses included.
        faces: (F, 3) vertex indices.
        edges: (E, 2) vertex indices, each edge once, smaller index first, rows in ascending order.
        face_edges: (F, 3) index of the edge from corner k to corner (k + 1) % 3.
        edge_face_offsets: (E + 1,) where each edge's faces start in `edge_faces`.
        edge_faces: (3F,) faces around each edge, ascending: two on a closed manifold, one on a boundary.
        face_pairs: (P, 2) pairs of faces that share an edge, smaller index first, in the order of the edges. An edge
            with k faces gives all k (k - 1) / 2 pairs.
        neighbor_offsets: (V + 1,) where each vertex's neighbours start in `neighbor_indices`.
        neighbor_indices: (2E,) the vertices joined to each vertex by an edge, ascending.

    Example:
        >>> vertices, faces = etsplat.icosphere(0)
        >>> topology = etsplat.MeshTopology.from_faces(faces, num_vertices=12)
        >>> len(topology.edges), len(topology.face_pairs)
        (30, 30)
    """

    __repr__ = short_repr

    num_vertices: int
    faces: Int[Tensor, "F 3"]
    edges: Int[Tensor, "E 2"]
    face_edges: Int[Tensor, "F 3"]
    edge_face_offsets: Int[Tensor, " E+1"]
    edge_faces: Int[Tensor, " 3F"]
    face_pairs: Int[Tensor, "P 2"]
    neighbor_offsets: Int[Tensor, " V+1"]
    neighbor_indices: Int[Tensor, " 2E"]

    @classmethod
    def from_faces(cls, faces: Int[Tensor, "F 3"], num_vertices: int) -> "MeshTopology":
        """Finds edges, adjacent faces and neighbours.

        Args:
            faces: (F, 3) integer vertex indices.
            num_vertices: V; every index is below it.

        Raises:
            ValueError: `faces` has another shape or dtype, an index is out of range, or a face repeats a vertex.
        """
        faces = _checked_faces(faces, num_vertices)
        tail, head = faces, faces.roll(-1, dims=1)
        keys = (torch.minimum(tail, head) * num_vertices + torch.maximum(tail, head)).reshape(-1)
        sorted_keys, half_edges = torch.sort(keys, stable=True)
        unique_keys, edge_of_sorted, counts = torch.unique_consecutive(
            sorted_keys, return_inverse=True, return_counts=True
        )
        face_edges = torch.empty_like(keys)
        face_edges[half_edges] = edge_of_sorted
        edges = torch.stack([unique_keys // max(num_vertices, 1), unique_keys % max(num_vertices, 1)], dim=1)
        edge_face_offsets = _offsets(counts)
        edge_faces = half_edges // 3
        neighbor_offsets, neighbor_indices = _neighbors(edges, num_vertices)
        return cls(
            num_vertices=num_vertices,
            faces=faces,
            edges=edges,
            face_edges=face_edges.reshape(-1, 3),
            edge_face_offsets=edge_face_offsets,
            edge_faces=edge_faces,
            face_pairs=_face_pairs(edge_face_offsets, edge_faces, counts),
            neighbor_offsets=neighbor_offsets,
            neighbor_indices=neighbor_indices,
        )

    def changed(self, faces: Int[Tensor, "F 3"] | None, vertices: Float[Tensor, "V 3"] | None) -> "MeshTopology":
        """That of other faces, on the same device, of these vertices or as many as before; this one if faces are None.

        Raises:
            ValueError: as `from_faces`.
        """
        if faces is None:
            return self
        return self.from_faces(faces.to(self.faces.device), self.num_vertices if vertices is None else len(vertices))

    def to(self, device: torch.device | str | None) -> "MeshTopology":
        """The same connectivity on another device; None for where it is."""
        if device is None or self.faces.device == torch.device(device):
            return self
        return replace(self, **{name: a.to(device) for name, a in vars(self).items() if isinstance(a, Tensor)})

    @property
    def num_faces(self) -> int:
        """F."""
        return len(self.faces)

    @property
    def edge_face_counts(self) -> Int[Tensor, " E"]:
        """How many faces meet in each edge."""
        return self.edge_face_offsets.diff()

    @cached_property
    def connectivity(self) -> MeshConnectivity:
        """What the mesh energies need, as int32, made on the first use."""
        return MeshConnectivity.build(
            self.edges, self.face_pairs, self.faces, self.neighbor_offsets, self.neighbor_indices
        )

    def is_closed(self) -> bool:
        """No boundary: every edge has at least two faces."""
        return bool((self.edge_face_counts >= 2).all())

    def is_manifold(self) -> bool:
        """Every edge has at most two faces, and the faces around every vertex form one fan (closed or open)."""
        return bool((self.edge_face_counts <= 2).all()) and self._fans() == self._used_vertices()

    def is_oriented(self) -> bool:
        """No two faces run along an edge in the same direction: neighbours agree which side is out."""
        forward = self.faces < self.faces.roll(-1, dims=1)
        counts = torch.bincount(self.face_edges[forward], minlength=len(self.edges))
        return bool((torch.maximum(counts, self.edge_face_counts - counts) <= 1).all())

    def euler_characteristic(self) -> int:
        """V - E + F with the vertices that faces use: 2 - 2 genus for each closed component."""
        return self._used_vertices() - len(self.edges) + self.num_faces

    def components(self) -> Int[Tensor, " F"]:
        """The connected component of each face, 0, 1, ...; faces that share a vertex are connected."""
        _, labels = connected(self.edges, self.num_vertices)
        _, compact = torch.unique(labels[self.faces[:, 0].cpu()], return_inverse=True)
        return compact.to(self.faces.device)

    def _used_vertices(self) -> int:
        return int((self.neighbor_offsets.diff() > 0).sum())

    def _fans(self) -> int:
        """Groups of face corners at one vertex that can be walked through across edges; one per vertex if manifold."""
        first, second = self.face_pairs.unbind(1)
        links = []
        for end in range(2):
            shared = self._shared_vertices()[:, end, None]
            links.append(
                torch.stack(
                    [
                        3 * first + (self.faces[first] == shared).int().argmax(dim=1),
                        3 * second + (self.faces[second] == shared).int().argmax(dim=1),
                    ],
                    dim=1,
                )
            )
        return connected(torch.cat(links), 3 * self.num_faces)[0]

    def _shared_vertices(self) -> Int[Tensor, "P 2"]:
        counts = self.edge_face_counts
        return self.edges.repeat_interleave(counts * (counts - 1) // 2, dim=0)


def _checked_faces(faces: Tensor, num_vertices: int) -> Int[Tensor, "F 3"]:
    check_shape("faces", faces, ("F", 3))
    check_indices("faces", faces, num_vertices)
    faces = faces.to(torch.int64).contiguous()
    repeated = (faces == faces.roll(-1, dims=1)).any(dim=1)
    if bool(repeated.any()):
        first = int(repeated.int().argmax())
        raise ValueError(f"faces must have three different vertices, got {faces[first].tolist()} for face {first}")
    return faces


def _offsets(counts: Int[Tensor, " N"]) -> Int[Tensor, " N+1"]:
    return torch.cat([counts.new_zeros(1), counts.cumsum(0)])


def _face_pairs(
    offsets: Int[Tensor, " E+1"], edge_faces: Int[Tensor, " 3F"], counts: Int[Tensor, " E"]
) -> Int[Tensor, "P 2"]:
    pairs, pair_edges = [], []
    for count in [2, *sorted(set(counts[counts > 2].tolist()))]:
        edges = torch.nonzero(counts == count)[:, 0]
        first, second = torch.triu_indices(count, count, offset=1, device=offsets.device)
        members = torch.stack([first, second], dim=1)
        pairs.append(edge_faces[offsets[edges, None, None] + members].reshape(-1, 2))
        pair_edges.append(edges.repeat_interleave(len(members)))
    if len(pairs) == 1:
        return pairs[0]
    return torch.cat(pairs)[torch.sort(torch.cat(pair_edges), stable=True).indices]


def _neighbors(edges: Int[Tensor, "E 2"], num_vertices: int) -> tuple[Int[Tensor, " V+1"], Int[Tensor, " 2E"]]:
    # The edges are in ascending order, so a stable sort by one end leaves the other ends ascending: first all
    # smaller neighbours, then all larger ones.
    ends = torch.cat([edges[:, 1], edges[:, 0]])
    others = torch.cat([edges[:, 0], edges[:, 1]])
    offsets = _offsets(torch.bincount(ends, minlength=num_vertices))
    return offsets, others[torch.sort(ends, stable=True).indices]


def connected(links: Int[Tensor, "L 2"], count: int) -> tuple[int, Int[Tensor, " N"]]:
    """Number of connected components of `count` nodes, and each node's component in order of first appearance."""
    rows, columns = links.cpu().numpy().T
    graph = coo_array((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(count, count))
    number, labels = connected_components(graph, directed=False)
    return int(number), torch.from_numpy(labels.astype(np.int64))
