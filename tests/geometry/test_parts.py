import torch
import trimesh

from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.parts import face_parts, genera


def _torus() -> tuple[torch.Tensor, torch.Tensor]:
    mesh = trimesh.creation.torus(1.0, 0.3, major_sections=12, minor_sections=8)
    return torch.from_numpy(mesh.vertices.copy()).float(), torch.from_numpy(mesh.faces.copy()).long()


def test_parts_are_numbered_by_their_faces_and_have_their_holes():
    """A torus of 192 faces and a sphere of 80, the smaller one first in the list of faces."""
    (v, f), (w, g) = icosphere(1), _torus()
    faces = torch.cat([f, g + len(v)])
    assert face_parts(faces, len(v) + len(w)).tolist() == [1] * len(f) + [0] * len(g)
    assert genera(faces, len(v) + len(w)) == [1, 0]


def test_no_faces_have_no_parts():
    assert genera(torch.zeros(0, 3, dtype=torch.long), 5) == []
