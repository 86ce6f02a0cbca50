"""Who is whose neighbour in a mesh, as the arrays that native code reads."""

from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

from etsplat.core.validation import check_indices, check_shape, dense

HOW_CONNECTED = "pass MeshTopology.from_faces(faces, num_vertices).connectivity"
"""For the end of messages of functions that are given something else."""


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


def _grouped(owners: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Offsets (count + 1,) and positions in ``owners`` grouped by owner, ascending within each."""
    sizes = torch.bincount(owners.long(), minlength=count)
    return torch.cat([sizes.new_zeros(1), sizes.cumsum(0)]), torch.sort(owners, stable=True).indices
