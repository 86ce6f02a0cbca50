"""The demo's object, built in code: an owl on an octagonal plinth.

It has what a reconstruction should be tried on: smooth rounds, sharp creases (plinth, beak, tail, shingled wings,
rims of the facial discs), thin tufts, and concavities (eye sockets, the undercuts between bird and plinth, a hollow
base).
"""

import numpy as np
import torch

from etsplat.core.precision import usual_defaults
from etsplat.data.meshing import dual_contour
from etsplat.io.mesh_files import MeshFile

_CELL = 0.0445
_CELLS = (45, 55, 45)
_LOWER = (-22.5 * _CELL, -1.22, -22.5 * _CELL)  # x = 0 runs through cell centres: the mesh is symmetric too


@usual_defaults()
def demo_object() -> MeshFile:
    """The demo's mesh: closed, manifold, genus 0, about 16,000 faces, all white; +y up, looking along +z.

    Deterministic. Takes about a second.

    Example:
        >>> owl = etsplat.demo_object()
        >>> owl.vertices.shape[1], len(owl.faces) > 10_000
        (3, True)
    """
    vertices, faces = dual_contour(owl, _LOWER, _CELL, _CELLS)
    return MeshFile(
        torch.from_numpy(vertices.astype(np.float32)), torch.from_numpy(faces), face_colors=torch.ones(len(faces), 3)
    )


def owl(points: np.ndarray) -> np.ndarray:
    """Signed distance-like function of the owl: (n, 3) points to (n,), negative inside."""
    p = points.copy()
    p[:, 0] = np.abs(p[:, 0])  # the bird is symmetric
    bird = _smooth_union(_body(p), _head(p), 0.12)
    bird = _smooth_union(bird, _wing(p), 0.05)
    bird = _smooth_union(bird, _tail(p), 0.05)
    bird = _smooth_union(bird, _feet(p), 0.05)
    return np.minimum(_face(bird, p), _plinth(points))


def _body(p: np.ndarray) -> np.ndarray:
    belly = _ellipsoid(p, (0, -0.13, 0.02), (0.58, 0.72, 0.5))
    # Rows of scalloped plumage on the chest.
    scallop = np.abs(np.cos(np.pi * p[:, 0] / 0.24))
    rows = _shingles((p[:, 1] + 0.07 * scallop) / 0.2)
    front = np.clip((p[:, 2] - 0.1) / 0.2, 0, 1) * np.clip((0.34 - p[:, 1]) / 0.1, 0, 1)
    return belly - 0.04 * (rows - 0.5) * front


def _head(p: np.ndarray) -> np.ndarray:
    skull = _ellipsoid(p, (0, 0.6, 0.03), (0.56, 0.4, 0.46))
    tuft = _round_cone(p, (0.32, 0.76, 0.06), (0.52, 1.1, 0.08), 0.17, 0.04)
    return _smooth_union(skull, tuft, 0.1)


def _face(bird: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Cut the facial discs, then put in eyes and beak."""
    cut = np.maximum(bird, -_sphere(p, (0.235, 0.62, 0.62), 0.3))
    eye = _sphere(p, (0.225, 0.63, 0.33), 0.13)
    beak = _round_cone(p, (0, 0.54, 0.42), (0, 0.35, 0.56), 0.13, 0.035)
    return np.minimum(np.minimum(cut, eye), beak)


def _wing(p: np.ndarray) -> np.ndarray:
    angle = 0.22  # leaning back, the tip behind and below
    y = p[:, 1] * np.cos(angle) + p[:, 2] * np.sin(angle)
    z = p[:, 2] * np.cos(angle) - p[:, 1] * np.sin(angle)
    blade = _ellipsoid(np.stack([p[:, 0], y, z], axis=1), (0.5, -0.12, -0.06), (0.19, 0.6, 0.36))
    return blade - 0.05 * (_shingles((y + 0.5 * np.abs(z + 0.06)) / 0.24) - 0.5)


def _tail(p: np.ndarray) -> np.ndarray:
    angle = -0.55  # the tip behind and below
    y = (p[:, 1] + 0.5) * np.cos(angle) - (p[:, 2] + 0.5) * np.sin(angle)
    z = (p[:, 2] + 0.5) * np.cos(angle) + (p[:, 1] + 0.5) * np.sin(angle)
    x = p[:, 0] * (1 + 0.6 * y)  # wider at the tip
    return _box(np.stack([x, y, z], axis=1), (0.19, 0.27, 0.08))


def _feet(p: np.ndarray) -> np.ndarray:
    toes = [_round_cone(p, (0.2, -0.78, 0.18), (x, -0.8, 0.54), 0.12, 0.07) for x in (0.12, 0.38)]
    return np.minimum(toes[0], toes[1])


def _plinth(p: np.ndarray) -> np.ndarray:
    # A corner points forward: the sides then take the light differently from the top.
    sector = np.pi / 4
    x, z = np.ascontiguousarray(p.T[[0, 2]])  # of columns numpy 1.26 gives one of two results
    angle = np.arctan2(x, z) % sector - sector / 2
    octagon = np.hypot(x, z) * np.cos(angle)
    upper = np.maximum(octagon - 0.63, np.abs(p[:, 1] + 0.89) - 0.08)
    lower = np.maximum(octagon - 0.78, np.abs(p[:, 1] + 1.03) - 0.1)
    return np.maximum(np.minimum(upper, lower), -_sphere(p, (0, -1.62, 0), 0.66))


def _shingles(t: np.ndarray) -> np.ndarray:
    """A saw-tooth of period 1 between 0 and 1 that rises slowly and falls steeply: overlapping feathers."""
    t = t % 1
    return np.where(t < 0.8, t / 0.8, (1 - t) / 0.2)


def _smooth_union(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """The union with a fillet of about `width`."""
    blend = np.maximum(width - np.abs(a - b), 0) / width
    return np.minimum(a, b) - blend * blend * width / 4


def _sphere(p: np.ndarray, center: tuple[float, float, float], radius: float) -> np.ndarray:
    return np.linalg.norm(p - center, axis=1) - radius


def _ellipsoid(p: np.ndarray, center: tuple[float, float, float], radii: tuple[float, float, float]) -> np.ndarray:
    q = (p - center) / radii
    length = np.linalg.norm(q, axis=1)
    slope = np.linalg.norm(q / radii, axis=1)
    return length * (length - 1) / np.maximum(slope, 1e-9)


def _box(p: np.ndarray, half: tuple[float, float, float]) -> np.ndarray:
    return (np.abs(p) - half).max(axis=1)


def _round_cone(
    p: np.ndarray, start: tuple[float, float, float], end: tuple[float, float, float], r0: float, r1: float
) -> np.ndarray:
    """A cone from radius `r0` at `start` to `r1` at `end`, with rounded ends."""
    axis = np.subtract(end, start)
    t = np.clip((p - start) @ axis / (axis @ axis), 0, 1)
    return np.linalg.norm(p - (start + t[:, None] * axis), axis=1) - (r0 + t * (r1 - r0))
