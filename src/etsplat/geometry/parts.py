"""Connected parts of a mesh, and their genus: how many holes go through each."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from etsplat.geometry.topology import MeshTopology, connected

_MOST_PARTS = 64
"""Of a surface whose parts are counted: more are grass or fur, which nobody counts."""


@dataclass(frozen=True)
class Shape:
    """How many parts a closed surface has, and how many holes go through them.

    Attributes:
        parts: those that lie within another one are left out, since nobody sees them; None where it is not clear.
        holes: the sum of their genera; None as `parts`.
        unclear: why it is not, as what follows "the mesh"; None where it is.
    """

    parts: int | None
    holes: int | None
    unclear: str | None = None


def face_parts(faces: Int64[Tensor, "F 3"], num_vertices: int) -> Int64[Tensor, " F"]:
    """The part that each face belongs to, those with most faces first; faces with a common vertex are together."""
    links = torch.stack([faces, faces.roll(1, dims=1)], dim=-1).reshape(-1, 2)
    label = connected(links, num_vertices)[1][faces[:, 0]]
    rank = torch.argsort(torch.argsort(label.bincount(), descending=True, stable=True))
    return rank[label]


def genera(faces: Int64[Tensor, "F 3"], num_vertices: int) -> list[int]:
    """The genus of each part of a closed mesh, in the order of `face_parts`: 1 - (V - E + F) / 2, rounded down."""
    part = face_parts(faces, num_vertices)
    part_of = torch.full((num_vertices,), -1)
    part_of[faces.reshape(-1)] = part.repeat_interleave(3)
    ends = faces, faces.roll(-1, dims=1)
    edges = (torch.minimum(*ends) * num_vertices + torch.maximum(*ends)).unique()
    V, E, F = (each.bincount() for each in (part_of[part_of >= 0], part_of[edges // max(num_vertices, 1)], part))
    return ((2 - (V - E + F)) // 2).tolist()


def shape_of(vertices: Float[Tensor, "V 3"], faces: Int64[Tensor, "F 3"]) -> Shape:
    """Counts the parts and holes of a closed manifold; of anything else they are unclear.

    Args:
        vertices: (V, 3), welded: what shares no vertex is apart.
        faces: (F, 3), none of which repeats a vertex.
    """
    topology = MeshTopology.from_faces(faces, len(vertices))
    if not topology.is_closed():
        return Shape(None, None, "is not closed")
    if not topology.is_manifold():
        return Shape(
            None, None, "is not a manifold: more than two faces meet in an edge, or surfaces touch in a vertex"
        )
    part = face_parts(faces, len(vertices))
    count = int(part.max()) + 1 if len(part) else 0
    if count > _MOST_PARTS:
        return Shape(None, None, f"has {count:,} parts")
    seen = [number for number in range(count) if not _within_another(vertices, faces, part, number)]
    found = genera(faces, len(vertices))
    return Shape(len(seen), sum(found[number] for number in seen))


def _within_another(vertices: Tensor, faces: Tensor, part: Tensor, number: int) -> bool:
    """Whether the first vertex of a part lies inside another: that one winds around it."""
    point = vertices[faces[part == number][0, 0]].double()
    for other in range(int(part.max()) + 1):
        if other == number:
            continue
        corners = vertices[faces[part == other]].double() - point
        around = (corners.amin(dim=(0, 1)) < 0).all() and (corners.amax(dim=(0, 1)) > 0).all()
        if around and abs(_winding(corners)) > 0.5:
            return True
    return False


def _winding(corners: Float[Tensor, "F 3 3"]) -> float:
    """How often a surface goes around the origin: the sum of the solid angles of its triangles over 4 pi.

    Van Oosterom and Strackee 1983: tan(angle / 2) = det(a, b, c) / (abc + (a.b) c + (b.c) a + (c.a) b).
    """
    a, b, c = corners.unbind(1)
    lengths = corners.norm(dim=2)
    volume = (a * torch.linalg.cross(b, c)).sum(dim=1)
    below = lengths.prod(dim=1) + sum(
        (corners[:, i] * corners[:, j]).sum(dim=1) * lengths[:, k] for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1))
    )
    return float(torch.atan2(volume, below).sum()) / (2 * math.pi)
