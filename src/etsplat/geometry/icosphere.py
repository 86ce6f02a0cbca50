"""The unit sphere as a subdivided icosahedron: the start of a shape reconstruction (paper, Implementation Details)."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from etsplat.core.validation import check_count
from etsplat.geometry.topology import MeshTopology

MAX_LEVEL = 12
"""336 million faces; each level more takes four times the memory, some 30 GB here."""


def icosphere(level: int) -> tuple[Float[Tensor, "V 3"], Int[Tensor, "F 3"]]:
    """Subdivides an icosahedron 1 -> 4 and projects onto the unit sphere, `level` times.

    Args:
        level: number of subdivisions, 0 to 12. The paper starts from level 4 (2,562 vertices, 5,120 faces).

    Returns:
        Vertices (V, 3) float32 of length 1 and faces (F, 3) int64, counter-clockwise seen from outside, with
        F = 20 * 4^level and V = F / 2 + 2. Closed, Euler characteristic 2.

    Raises:
        ValueError: `level` is no such number.

    Example:
        >>> vertices, faces = etsplat.icosphere(4)
        >>> vertices.shape, faces.shape
        (torch.Size([2562, 3]), torch.Size([5120, 3]))
    """
    level = check_count("level", level, least=0, most=MAX_LEVEL)
    vertices, faces = _icosahedron()
    for _ in range(level):
        topology = MeshTopology.from_faces(faces, len(vertices))
        midpoints = torch.nn.functional.normalize(vertices[topology.edges].sum(dim=1), dim=1)
        a, b, c = faces.unbind(1)
        ab, bc, ca = (topology.face_edges + len(vertices)).unbind(1)
        children = (a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)
        faces = torch.stack([torch.stack(child, dim=1) for child in children], dim=1).reshape(-1, 3)
        vertices = torch.cat([vertices, midpoints])
    return vertices.float(), faces


def _icosahedron() -> tuple[Float[Tensor, "12 3"], Int[Tensor, "20 3"]]:
    """A pole, two rings of five vertices, a pole; float64."""
    height = 1 / math.sqrt(5)
    ring = [(math.cos(k * math.pi / 5), math.sin(k * math.pi / 5)) for k in range(10)]
    upper = [(2 * height * x, 2 * height * y, height) for x, y in ring[0::2]]
    lower = [(2 * height * x, 2 * height * y, -height) for x, y in ring[1::2]]
    vertices = torch.tensor([(0.0, 0.0, 1.0), *upper, *lower, (0.0, 0.0, -1.0)], dtype=torch.float64)
    faces = []
    for k in range(5):
        up, next_up, down, next_down = 1 + k, 1 + (k + 1) % 5, 6 + k, 6 + (k + 1) % 5
        faces += [(0, up, next_up), (up, down, next_up), (next_up, down, next_down), (11, next_down, down)]
    return torch.nn.functional.normalize(vertices, dim=1), torch.tensor(faces)
