"""Exact distances from points to a triangle mesh."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from etsplat import _native
from etsplat.core.validation import check_shape, dense
from etsplat.geometry.measures import native_mesh


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
    check_shape("points", points, ("N", 3))
    if not bool(points.isfinite().all()):
        raise ValueError("points must be finite, got NaN or infinity")
    points = dense(points.cpu().double(), "points")
    vertices, faces = native_mesh(vertices, faces)
    if len(faces) == 0:
        raise ValueError("faces must not be empty")
    squared = torch.empty(len(points), dtype=torch.float64)
    nearest = torch.empty(len(points), dtype=torch.int64)
    _native.closest_faces(points=points, vertices=vertices, faces=faces, squared_distances=squared, closest=nearest)
    return squared, nearest
