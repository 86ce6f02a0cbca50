"""Areas, volume and size of triangle meshes."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from etsplat.core.validation import check_indices, check_shape, dense


def area_normals(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "F 3"]:
    """Normals of faces, as long as twice their areas."""
    a, b, c = vertices[faces].unbind(1)
    return torch.linalg.cross(b - a, c - a)


def face_areas(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, " F"]:
    """The area of each face, in the dtype of the vertices; zero where a face repeats a vertex."""
    return 0.5 * area_normals(vertices, faces).norm(dim=1)


def vertex_normals(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "V 3"]:
    """(V, 3) unit normals, the mean of the faces' weighted by area; 0 for a vertex without one."""
    across, total = area_normals(vertices, faces), torch.zeros_like(vertices)
    for corner in faces.T:
        total = total.index_add(0, corner, across)
    return torch.nn.functional.normalize(total, dim=1)


def mean_edge(vertices: Float[Tensor, "V 3"], edges: Int[Tensor, "E 2"]) -> float:
    """The mean length of edges, in the units of the vertices."""
    return float((vertices[edges[:, 0]] - vertices[edges[:, 1]]).norm(dim=1).mean())


def enclosed_volume(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> float:
    """The volume inside a closed oriented mesh, positive if its normals point outwards: sum of a . (b x c) / 6."""
    corners = vertices[faces].double()
    corners = corners - corners.mean(dim=(0, 1))
    a, b, c = corners.unbind(1)
    return float((a * torch.linalg.cross(b, c)).sum()) / 6


def bounding_ball(vertices: Float[Tensor, "V 3"]) -> tuple[Float[Tensor, " 3"], float]:
    """The centre of the bounding box and the largest distance of a vertex from it (normalisation divides by it)."""
    points = vertices.double()
    center = 0.5 * (points.amin(dim=0) + points.amax(dim=0))
    return center, float((points - center).norm(dim=1).max())


def native_mesh(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> tuple[Float[Tensor, "V 3"], Int[Tensor, "F 3"]]:
    """The mesh as the native geometry code reads it: contiguous float64 and int64 on the CPU, checked.

    Raises:
        ValueError: a shape is wrong, a coordinate is not finite, or an index is out of range.
    """
    check_shape("vertices", vertices, ("V", 3))
    check_shape("faces", faces, ("F", 3))
    check_indices("faces", faces, len(vertices))
    if not bool(vertices.isfinite().all()):
        raise ValueError("vertices must be finite, got NaN or infinity")
    return dense(vertices.cpu().double(), "vertices"), dense(faces.cpu().to(torch.int64), "faces")
