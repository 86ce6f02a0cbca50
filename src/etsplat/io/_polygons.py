"""Polygons of mesh files, which are cut into fans: those that a fan does not fill are cut at their ears."""

from collections.abc import Sequence

import numpy as np

_FOLDED = 1e-9
"""A triangle that counts against its polygon by more than this part of its area is one that a fan has folded over."""


def cut_concave(
    vertices: np.ndarray, faces: np.ndarray, polygons: Sequence[tuple[int, int]], *others: np.ndarray
) -> None:
    """Cut polygons again, in place, of which the fan from their first corner reaches beyond them.

    Those that cross themselves stay as they are, and all of them where indices are out of range.

    Args:
        vertices: (V, 3).
        faces: (F, 3) the triangles of all fans.
        polygons: of each with more than three corners, its first triangle and how many corners it has.
        others: (F, 3) more numbers of the same corners.
    """
    if not polygons or faces.min() < 0 or faces.max() >= len(vertices) or not np.isfinite(vertices).all():
        return
    starts, counts = np.array(polygons).T
    numbers = np.repeat(np.arange(len(starts)), counts - 2)
    rows = np.concatenate([np.arange(start, start + count - 2) for start, count in polygons])
    a, b, c = (vertices[faces[rows, corner]] for corner in range(3))
    with np.errstate(over="ignore", invalid="ignore"):
        areas = np.cross(b - a, c - a)
        whole = np.stack([np.bincount(numbers, areas[:, axis], len(starts)) for axis in range(3)], axis=1)
        against = (areas * whole[numbers]).sum(axis=1) < -_FOLDED * (whole**2).sum(axis=1)[numbers]
    for number in np.unique(numbers[against]).tolist():
        start, count = polygons[number]
        fan = slice(start, start + count - 2)
        loop = _loop(faces[fan])
        found = ears(vertices[loop], whole[number])
        if found is not None:
            for array in (faces, *others):
                array[fan] = _loop(array[fan])[found]


def ears(points: np.ndarray, normal: np.ndarray) -> np.ndarray | None:
    """(n - 2, 3) numbers of corners: the triangles of a simple polygon; None if it is none.

    Args:
        points: (n, 3) its corners.
        normal: (3,) of the side from which they run counterclockwise, of any length but 0.
    """
    axis = int(np.abs(normal).argmax())
    flat = np.roll(points, -axis - 1, axis=1)[:, :2]  # the other two axes, right-handed about this one
    if normal[axis] < 0:
        flat = flat[:, ::-1]
    left, found = list(range(len(points))), list[tuple[int, int, int]]()
    while len(left) > 3:
        at = _ear(flat[left])
        if at is None:
            return None
        found.append((left[at - 1], left[at], left[(at + 1) % len(left)]))
        del left[at]
    return np.array([*found, tuple(left)])


def _ear(loop: np.ndarray) -> int | None:
    """The number of a corner of a polygon (n, 2) that can be cut off: the first that turns left, with none within."""
    before, after = np.roll(loop, 1, axis=0), np.roll(loop, -1, axis=0)
    turns = _turn(before, loop, after)
    reflex = loop[turns <= 0]
    for at in (*np.flatnonzero(turns > 0), *np.flatnonzero(turns == 0)):
        a, b, c = before[at], loop[at], after[at]
        others = reflex[(reflex != a).any(axis=1) & (reflex != b).any(axis=1) & (reflex != c).any(axis=1)]
        within = (_turn(a, b, others) >= 0) & (_turn(b, c, others) >= 0) & (_turn(c, a, others) >= 0)
        if not within.any():
            return int(at)
    return None


def _turn(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """(n,) twice the areas of triangles (n, 2), positive where their corners run counterclockwise."""
    return (b - a)[..., 0] * (c - a)[..., 1] - (b - a)[..., 1] * (c - a)[..., 0]


def _loop(fan: np.ndarray) -> np.ndarray:
    """(n,) the corners of a polygon, of its fan (n - 2, 3)."""
    return np.concatenate([fan[0, :2], fan[:, 2]])
