"""The energies that keep a mesh well shaped (paper, section 3.3), with analytic gradients.

    L_e   = 1/|E| sum over edges of |e|               (or |e|^2, as in pytorch3d)
    L_n   = 1/|P| sum over pairs of adjacent faces of 1 - n0 . n1
    L_lap = 1/|V| sum over vertices of |v_i - mean of its neighbours|

What has no direction gives no gradient: an edge or a Laplacian of length 1e-12 or less, and a face whose doubled area
is at most 1e-6 of its longest edge squared, whose pairs count 0 in L_n. A vertex without neighbours counts 0 in L_lap.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from etsplat import _native
from etsplat.core.validation import check_indices, check_shape, dense
from etsplat.ops._mesh_energies_cuda import MeshEnergiesCuda
from etsplat.ops.engines import resolve_engine

_MIN_LENGTH = 1e-12
_MIN_SHAPE = 1e-6


class MeshEnergies(NamedTuple):
    """Three differentiable scalars.

    Attributes:
        edge: L_e.
        normal: L_n, in [0, 2].
        laplacian: L_lap.
    """

    edge: Float[Tensor, ""]
    normal: Float[Tensor, ""]
    laplacian: Float[Tensor, ""]


@dataclass(frozen=True)
class MeshConnectivity:
    """Who is whose neighbour, as contiguous int32, checked once. Build it with `build`.

    Attributes:
        edges: (E, 2) vertices of each edge.
        face_pairs: (P, 2) faces that share an edge.
        faces: (F, 3) vertices of each face.
        neighbor_offsets: (V + 1,) where each vertex's neighbours start in `neighbor_indices`.
        neighbor_indices: (2E,) vertices joined to each vertex by an edge.
        corner_offsets: (V + 1,) where each vertex's corners start in `corners`.
        corners: (3F,) 3 f + k for corner k of face f, ascending for each vertex.
        pair_offsets: (F + 1,) where each face's partners start in `paired_faces`.
        paired_faces: (2P,) the other face of each pair of a face.
    """

    edges: Int[Tensor, "E 2"]
    face_pairs: Int[Tensor, "P 2"]
    faces: Int[Tensor, "F 3"]
    neighbor_offsets: Int[Tensor, " V+1"]
    neighbor_indices: Int[Tensor, " 2E"]
    corner_offsets: Int[Tensor, " V+1"]
    corners: Int[Tensor, " 3F"]
    pair_offsets: Int[Tensor, " F+1"]
    paired_faces: Int[Tensor, " 2P"]

    @classmethod
    def build(
        cls,
        edges: Int[Tensor, "E 2"],
        face_pairs: Int[Tensor, "P 2"],
        faces: Int[Tensor, "F 3"],
        neighbor_offsets: Int[Tensor, " V+1"],
        neighbor_indices: Int[Tensor, " 2E"],
    ) -> "MeshConnectivity":
        """Check the arrays and derive the others.

        Args:
            edges: (E, 2), each edge once.
            face_pairs: (P, 2), each pair once.
            faces: (F, 3).
            neighbor_offsets: (V + 1,), ascending from 0 to 2E.
            neighbor_indices: (2E,), both ends of every edge.

        Raises:
            ValueError: A wrong shape or dtype, an index out of range, or offsets that do not fit.
        """
        for name, array in (("edges", edges), ("face_pairs", face_pairs)):
            check_shape(name, array, ("N", 2))
        check_shape("faces", faces, ("F", 3))
        check_shape("neighbor_offsets", neighbor_offsets, ("V",))
        check_shape("neighbor_indices", neighbor_indices, (2 * len(edges),))
        num_vertices = len(neighbor_offsets) - 1
        for name, array in (("edges", edges), ("faces", faces), ("neighbor_indices", neighbor_indices)):
            check_indices(name, array, num_vertices)
        check_indices("face_pairs", face_pairs, len(faces))
        check_indices("neighbor_offsets", neighbor_offsets, 2 * len(edges) + 1)
        ascending = bool((neighbor_offsets.diff() >= 0).all())
        if num_vertices < 0 or not ascending or int(neighbor_offsets[0]) != 0:
            raise ValueError("neighbor_offsets must ascend from 0")
        if int(neighbor_offsets[-1]) != 2 * len(edges):
            raise ValueError(f"neighbor_offsets must end at {2 * len(edges)}, got {int(neighbor_offsets[-1])}")
        corner_offsets, corners = _grouped(faces.reshape(-1), num_vertices)
        pair_offsets, ends = _grouped(face_pairs.reshape(-1), len(faces))
        paired_faces = face_pairs.flip(1).reshape(-1)[ends]
        arrays = (edges, face_pairs, faces, neighbor_offsets, neighbor_indices)
        derived = (corner_offsets, corners, pair_offsets, paired_faces)
        return cls(*(dense(array).to(torch.int32, copy=True) for array in (*arrays, *derived)))

    @property
    def num_vertices(self) -> int:
        """V."""
        return len(self.neighbor_offsets) - 1


def mesh_energies(
    vertices: Float[Tensor, "V 3"],
    connectivity: MeshConnectivity,
    *,
    edge_power: int = 1,
    engine: str | None = None,
) -> MeshEnergies:
    """L_e, L_n and L_lap of a mesh, differentiable by its vertices.

    Args:
        vertices: (V, 3).
        connectivity: Of the mesh; ``MeshTopology.connectivity``.
        edge_power: 1 for the mean length of the edges (the paper's formula), 2 for the mean squared length.
        engine: "cpu", "cuda", "reference" or None (by dtype and device).

    Returns:
        The three scalars. The native engines' values and gradients are the same bits in every run, for any number of
        threads.

    Raises:
        ValueError: Wrong shape, dtype or device, or another power.
    """
    check_shape("vertices", vertices, (connectivity.num_vertices, 3))
    if connectivity.faces.device != vertices.device:
        raise ValueError(f"connectivity must be on {vertices.device}, got {connectivity.faces.device}")
    if edge_power not in (1, 2):
        raise ValueError(f"edge_power must be 1 or 2, got {edge_power}")
    chosen = resolve_engine(engine, vertices)
    if chosen == "reference":
        return _mesh_energies_reference(vertices, connectivity, edge_power)
    native = MeshEnergiesCuda if chosen == "cuda" else _MeshEnergies
    energies: Any = native.apply(vertices, connectivity, edge_power)
    return MeshEnergies(*energies)


class _MeshEnergies(torch.autograd.Function):
    """One native call computes the values and the three gradients, which backward combines."""

    @staticmethod
    def forward(
        ctx: Any, vertices: Tensor, connectivity: MeshConnectivity, edge_power: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        vertices = dense(vertices, "vertices")
        gradients = vertices.new_empty((3, *vertices.shape))
        c = connectivity
        adjacency = (c.faces, c.neighbor_offsets, c.neighbor_indices, c.corner_offsets, c.corners, c.pair_offsets)
        edge, normal, laplacian = _native.mesh_energies(
            vertices.data_ptr(),
            *(array.data_ptr() for array in (*adjacency, c.paired_faces)),
            c.num_vertices,
            len(c.edges),
            len(c.face_pairs),
            len(c.faces),
            edge_power,
            gradients.data_ptr(),
        )
        ctx.save_for_backward(gradients)
        return vertices.new_tensor(edge), vertices.new_tensor(normal), vertices.new_tensor(laplacian)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, edge: Tensor, normal: Tensor, laplacian: Tensor) -> tuple[Tensor, None, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        gradients = dense(ctx.saved_tensors[0])
        combined = torch.empty_like(gradients[0])
        weights = [float(edge), float(normal), float(laplacian)]
        _native.combine_mesh_gradients(gradients.data_ptr(), weights, combined.numel(), combined.data_ptr())
        return combined, None, None


def _mesh_energies_reference(vertices: Tensor, connectivity: MeshConnectivity, edge_power: int) -> MeshEnergies:
    tail, head = vertices[connectivity.edges.long()].unbind(dim=1)
    edge = _length(head - tail) if edge_power == 1 else (head - tail).square().sum(dim=1)

    normals, usable = _normals(*vertices[connectivity.faces.long()].unbind(dim=1))
    first, second = connectivity.face_pairs.long().unbind(dim=1)
    disagreement = 1 - (normals[first] * normals[second]).sum(dim=1)
    normal = torch.where(usable[first] & usable[second], disagreement, 0)

    offsets = connectivity.neighbor_offsets.long()
    counts = offsets.diff()
    owner = torch.repeat_interleave(torch.arange(len(vertices), device=vertices.device), counts)
    sums = torch.zeros_like(vertices).index_add(0, owner, vertices[connectivity.neighbor_indices.long()])
    mean = sums / counts.clamp(min=1)[:, None]
    laplacian = _length(torch.where(counts[:, None] > 0, vertices - mean, 0))
    return MeshEnergies(_mean(edge), _mean(normal), _mean(laplacian))


def _mean(values: Tensor) -> Tensor:
    """The mean, 0 of nothing."""
    return values.sum() / max(1, len(values))


def _length(vectors: Tensor) -> Tensor:
    """Norms with zero gradient where they vanish."""
    square = vectors.square().sum(dim=1)
    positive = square > _MIN_LENGTH**2
    return torch.where(positive, torch.where(positive, square, 1).sqrt(), 0)


def _normals(a: Tensor, b: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    """Unit normals, and which faces have one."""
    cross = torch.linalg.cross(b - a, c - a)
    longest = torch.stack([(b - a), (c - a), (c - b)]).square().sum(dim=2).amax(dim=0)
    square = cross.square().sum(dim=1)
    usable = (square > (_MIN_SHAPE * longest) ** 2).detach()
    return cross / torch.where(usable, square, 1).sqrt()[:, None], usable


def _grouped(owners: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Offsets (count + 1,) and positions in ``owners`` grouped by owner, ascending within each."""
    sizes = torch.bincount(owners.long(), minlength=count)
    return torch.cat([sizes.new_zeros(1), sizes.cumsum(0)]), torch.sort(owners, stable=True).indices
