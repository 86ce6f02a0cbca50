"""Exact distances from points to a triangle mesh."""

import torch
from jaxtyping import Float, Int, Int64
from torch import Tensor

from etsplat import _native
from etsplat.core.validation import check_shape, dense
from etsplat.geometry.measures import native_mesh


class ClosestPoints:
    """A triangle mesh that is asked more than once how far points are from it; else `closest_points` does.

    Args:
        vertices: (V, 3) finite.
        faces: (F, 3), at least one.

    Raises:
        ValueError: a shape is wrong, a coordinate is not finite, an index is out of range, or there are no faces.
    """

    def __init__(self, vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> None:
        vertices, faces = native_mesh(vertices, faces)
        if len(faces) == 0:
            raise ValueError("faces must not be empty")
        self._tree = _native.face_tree(vertices=vertices, faces=faces)

    def __call__(self, points: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, " N"], Int[Tensor, " N"]]:
        """As `closest_points`."""
        check_shape("points", points, ("N", 3))
        if not bool(points.isfinite().all()):
            raise ValueError("points must be finite, got NaN or infinity")
        points = dense(points.cpu().double(), "points")
        squared = torch.empty(len(points), dtype=torch.float64)
        nearest = torch.empty(len(points), dtype=torch.int64)
        _native.closest_faces(tree=self._tree, points=points, squared_distances=squared, closest=nearest)
        return squared, nearest


def closest_points(
    points: Float[Tensor, "N 3"], vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> tuple[Float[Tensor, " N"], Int[Tensor, " N"]]:
    """Distance from each point to the surface, and the face where the surface is nearest.

    No sampling and no approximation: a bounding volume hierarchy in float64 (csrc/cpu/bvh.h), all cores. Degenerate
    faces count as the segments or points that they are. Of faces that are equally near (a shared edge or corner),
    rounding may decide; of equal rounded distances the smallest index does. The same for any number of threads.

    Args:
        points: (N, 3) finite.
        vertices: (V, 3) finite.
        faces: (F, 3), at least one.

    Returns:
        Squared distances (N,) float64 and face indices (N,) int64.

    Raises:
        ValueError: a shape is wrong, a coordinate is not finite, an index is out of range, or there are no faces.
    """
    return ClosestPoints(vertices, faces)(points)


def closest_places(
    points: Float[Tensor, "N 3"], vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> tuple[Int64[Tensor, " N"], Float[Tensor, "N 3"]]:
    """Where on a mesh points are nearest to it; arguments and errors as of `closest_points`.

    Returns:
        Face indices (N,) and barycentric coordinates (N, 3) float64 of the nearest points, on the CPU.
    """
    _, face = closest_points(points, vertices, faces)
    corners = vertices.detach().cpu().double()[faces.cpu().long()[face]]
    seen = points.detach().cpu().double()
    weights = foot_weights(seen, corners)
    outside = (weights < 0).any(dim=1)
    weights[outside] = _border_weights(seen[outside], corners[outside])
    return face, weights


def foot_weights(points: Float[Tensor, "N 3"], corners: Float[Tensor, "N 3 3"]) -> Float[Tensor, "N 3"]:
    """Barycentric coordinates (N, 3) of the feet of perpendiculars from points (N, 3) to triangles (N, 3, 3).

    Negative somewhere where a foot is outside, and of triangles without area.
    """
    a, b, c = corners.unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    area = (normal * normal).sum(dim=1)
    v = (torch.linalg.cross(points - a, c - a) * normal).sum(dim=1) / area
    w = (torch.linalg.cross(b - a, points - a) * normal).sum(dim=1) / area
    weights = torch.stack([1 - v - w, v, w], dim=1)
    return torch.where(area[:, None] > 0, weights, torch.full_like(weights, -1.0))


def _border_weights(points: Tensor, corners: Tensor) -> Tensor:
    """(N, 3) of the nearest points of the three edges."""
    best, nearest = torch.zeros(len(points), 3, dtype=torch.float64), torch.full((len(points),), torch.inf).double()
    for first in range(3):
        second = (first + 1) % 3
        start, along = corners[:, first], corners[:, second] - corners[:, first]
        length = (along * along).sum(dim=1).clamp_min(torch.finfo(torch.float64).tiny)
        part = (((points - start) * along).sum(dim=1) / length).clamp(0, 1)
        squared = (points - start - part[:, None] * along).square().sum(dim=1)
        weights = torch.zeros_like(best)
        weights[:, first], weights[:, second] = 1 - part, part
        closer = squared < nearest
        best, nearest = torch.where(closer[:, None], weights, best), torch.where(closer, squared, nearest)
    return best
