"""Parts of a visual hull that are thinner than the cells of a grid, and so fall between its nodes.

There the hull is contoured with a skin about it that no grid of such cells can miss, and its vertices then go back to
the hull: a wire has few faces around it, but it is whole.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.ndimage import binary_dilation, map_coordinates, maximum_filter

Field = Callable[[Float[np.ndarray, "N 3"]], Float[np.ndarray, " N"]]
"""Distance from a surface at each point, about, negative inside."""

_STEEPEST = 1.1
"""Of distances by silhouettes: towards the border of a photo a pixel is seen at a slant."""

_SPLITS = 3
"""A cell is halved so often along each axis in search of a part in it."""

_AROUND = 2
"""Cells around one that is full, in which nothing is thin; and nodes around one that is thin, on which the skin is."""

_STEPS, _STEP, _LEAST_SLOPE = 12, 0.02, 0.5
"""In which vertices go back; by differences over so much of a cell; and what these are at least, by which a way is
found where silhouettes meet."""


@dataclass(frozen=True)
class ThinParts:
    """Where a hull is thinner than a grid sees.

    Attributes:
        field: of the hull.
        corner: of the grid, along each axis.
        cell: side of its cells.
        values: (n + 1, n + 1, n + 1) of the field at the nodes.
        skin: (n + 1, n + 1, n + 1) how thick a skin about it is to be there.
    """

    field: Field
    corner: float
    cell: float
    values: Float[np.ndarray, "X Y Z"]
    skin: Float[np.ndarray, "X Y Z"]

    @classmethod
    def of(cls, field: Field, cells: int, cell: float) -> "ThinParts":
        """Looks for them in a cube about the origin."""
        corner = -0.5 * cell * cells
        axis = corner + cell * np.arange(cells + 1)
        nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
        values = field(nodes.reshape(-1, 3)).reshape(nodes.shape[:3])
        around = np.stack([values[tuple(slice(at, at + cells) for at in way)] for way in np.ndindex(2, 2, 2)])
        # What is near to a cell that is full the grid sees.
        seen = np.asarray(binary_dilation((around < 0).all(axis=0), np.ones((3, 3, 3)), iterations=_AROUND), dtype=bool)
        found = np.argwhere(~seen & (around.min(axis=0) <= _reach(cell)))
        deep = _deepest(field, corner + cell * (found + 0.5), cell)
        skin = np.zeros_like(values)
        for way in np.ndindex(2, 2, 2):
            at = tuple((found + way).T)
            skin[at] = np.maximum(skin[at], np.where(deep >= 0, (_reach(cell) - deep).clip(min=0), 0.0))
        return cls(field, corner, cell, values, maximum_filter(skin, 2 * _AROUND + 1))

    def skinned(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
        """The field of the hull with a skin about thin parts: along them each node that is nearest is in it."""
        return self.field(points) - self._skin(points)

    def without_skin(self, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3"]:
        """Vertices of the surface with the skin, where those that have it are on the hull."""
        vertices, step = vertices.copy(), _STEP * self.cell
        moving = np.flatnonzero(self._skin(vertices) > 0)
        for _ in range(_STEPS):
            beyond = self.field(vertices[moving])
            moving, beyond = moving[beyond > 0], beyond[beyond > 0]
            if len(moving) == 0:
                break
            at = vertices[moving]
            slope = np.stack(
                [(self.field(at + way) - self.field(at - way)) / (2 * step) for way in step * np.eye(3)], axis=1
            )
            steep = np.maximum((slope**2).sum(axis=1), _LEAST_SLOPE**2)
            vertices[moving] = at - (beyond / steep)[:, None] * slope
        return vertices

    def _skin(self, points: np.ndarray) -> np.ndarray:
        return map_coordinates(self.skin, ((points - self.corner) / self.cell).T, order=1, mode="nearest")


def _reach(cell: float) -> float:
    """Values of a field from the middle of a cube to its corners, at most."""
    return _STEEPEST * 3**0.5 / 2 * cell


def _deepest(field: Field, centers: np.ndarray, cell: float) -> np.ndarray:
    """(N,) how deep a hull is in the cubes of such a side about points; negative where there is none in one."""
    own = np.arange(len(centers))
    deep = np.full(len(centers), -np.inf)
    ways = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    for _ in range(_SPLITS):
        kept = field(centers) <= _reach(cell)
        cell /= 2
        centers, own = (centers[kept, None] + cell * ways).reshape(-1, 3), own[kept].repeat(8)
    np.maximum.at(deep, own, -field(centers))
    return deep
