"""Random points on a surface, the same on every machine."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from etsplat.core.validation import check_indices, dense


def sample_surface(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], count: int, seed: int | Sequence[int]
) -> tuple[Float[Tensor, "N 3"], Int[Tensor, " N"]]:
    """Draws independent points, uniform in area.

    Only NumPy's generator, correctly rounded operations and sequential sums take part, all in float64, so that a seed
    gives the same points on any machine and for any number of threads.

    Args:
        vertices: (V, 3) finite.
        faces: (F, 3). Faces without area get no points.
        count: N, at least 0.
        seed: a non-negative integer or several; different seeds give independent points.

    Returns:
        Points (N, 3) float64 and the face of each (N,) int64, in random order.

    Raises:
        ValueError: there is no area to draw from, a vertex is not finite, or an index is out of range.
    """
    points, triangles = (dense(given, name).cpu() for name, given in (("vertices", vertices), ("faces", faces)))
    check_indices("faces", triangles, len(points))
    corners = points.double().numpy()[triangles.numpy()]
    if len(corners) == 0 or not np.isfinite(corners).all():
        raise ValueError("vertices and faces must be a finite surface, got no faces, NaN or infinity")
    origin, side1, side2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    cumulative = np.cumsum(_cross_lengths(side1, side2))
    if cumulative[-1] == 0:
        raise ValueError("vertices and faces must be a surface with area, got zero area")
    rng = np.random.default_rng(seed)
    # Scaling may round up to the total itself, where the search would land behind the last face or on an empty one.
    position = np.minimum(rng.random(count) * cumulative[-1], np.nextafter(cumulative[-1], 0))
    face = np.searchsorted(cumulative, position, side="right")
    # Uniform in the parallelogram, folded onto the triangle.
    u, v = rng.random((2, count))
    fold = u + v > 1
    u, v = np.where(fold, 1 - u, u)[:, None], np.where(fold, 1 - v, v)[:, None]
    return torch.from_numpy(origin[face] + u * side1[face] + v * side2[face]), torch.from_numpy(face)


def _cross_lengths(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """|a x b| from single products and sums: library norms may order or fuse them differently on another machine."""
    x = a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1]
    y = a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]
    z = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return np.sqrt(x * x + y * y + z * z)
