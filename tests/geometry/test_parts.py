import torch
import trimesh

from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.parts import Shape, face_parts, genera, shape_of


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


def test_parts_that_nobody_sees_do_not_count():
    """A torus inside a ball; beside it, both count; an open surface and one that pinches are unclear."""
    (v, f), (w, g) = icosphere(1), _torus()
    faces = torch.cat([f, g + len(v)])
    assert shape_of(torch.cat([v, 0.3 * w]), faces) == Shape(1, 0)
    assert shape_of(torch.cat([v, w + 3]), faces) == Shape(2, 1)
    assert shape_of(v, f[1:]).unclear == "is not closed"
    pinched = torch.where(f == 0, len(v), f + len(v) + 1)
    pinched = torch.where(pinched == len(v), 0, pinched)
    touching = shape_of(torch.cat([v, v[:1], 2 * v[0] - v]), torch.cat([f, pinched]))
    assert touching.unclear is not None
    assert touching.unclear.startswith("is not a manifold")
