"""Small meshes for tests, and a reader that keeps a shared OBJ as it is written."""

from pathlib import Path

import torch
import trimesh
from torch import Tensor

from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.measures import bounding_ball
from etsplat.io.mesh_files import MeshFile

TETRAHEDRON_FACES = torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
TETRAHEDRON = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]), TETRAHEDRON_FACES.flip(1)

FAMOUS = [
    "armadillo",
    "boot",
    "bunny_hr",
    "cow-low-resolution",
    "goathead",
    "hand_closed",
    "human_neutral",
    "koala",
    "mushroom",
    "springer",
]


PLY_HEADER = (
    "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
    "element face {}\nproperty list uchar int vertex_indices\nend_header\n"
)
"""Of a text with so many vertices and faces."""


def colored_ball() -> tuple[Tensor, Tensor, Tensor]:
    """Vertices and faces of an icosphere, and colours of its faces that 8 bits hold."""
    vertices, faces = icosphere(2)
    colors = torch.randint(0, 256, (len(faces), 3), generator=torch.Generator().manual_seed(1)).float() / 255
    return vertices, faces, colors


def bumpy_sphere(level: int, seed: int, amplitude: float = 0.3) -> tuple[Tensor, Tensor]:
    """An icosphere whose vertices are displaced at random, by about `amplitude` edge lengths."""
    vertices, faces = icosphere(level)
    noise = torch.randn(vertices.shape, generator=torch.Generator().manual_seed(seed))
    return vertices + amplitude * noise * 2.0**-level, faces


def read_obj(path: Path) -> tuple[Tensor, Tensor]:
    """Vertices (float64) and triangles of an OBJ, vertices shared as in the file, normalised to radius 1."""
    vertices, faces = [], []
    for line in path.read_text().splitlines():
        if line.startswith("v "):
            vertices.append([float(value) for value in line.split()[1:4]])
        elif line.startswith("f "):
            faces.append([int(corner.split("/")[0]) - 1 for corner in line.split()[1:4]])
    points = torch.tensor(vertices, dtype=torch.float64)
    center, radius = bounding_ball(points)
    return (points - center) / radius, torch.tensor(faces)


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Unit normals, faces weighted by area."""
    a, b, c = vertices[faces].unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    total = torch.zeros_like(vertices).index_add(0, faces.reshape(-1), normal.repeat_interleave(3, dim=0))
    return torch.nn.functional.normalize(total, dim=1)


def ring_and_ball(thickness: float) -> MeshFile:
    """A torus around the z axis, as thick as that, with a ball above its hole: two parts, one hole."""
    ring = trimesh.creation.torus(0.5, thickness, major_sections=48, minor_sections=24)
    v, f = icosphere(3)
    w = torch.from_numpy(ring.vertices.copy()).float()
    vertices = torch.cat([w, 0.15 * v + torch.tensor([0.0, 0.0, 0.6])])
    return MeshFile(vertices, torch.cat([torch.from_numpy(ring.faces.copy()).long(), f + len(w)]))
