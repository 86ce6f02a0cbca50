"""Relief of a full mesh over a light one."""

import pytest
import torch

from etsplat.geometry.distance import foot_weights
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.measures import vertex_normals
from etsplat.geometry.unwrap import texel_points, unwrapped
from etsplat.io.mesh_files import MeshFile
from etsplat.model.textured_mesh import TexturedMesh
from etsplat.tasks.normal_map import normal_map_of

pytest.importorskip("xatlas")

SIZE = 128


@pytest.fixture(scope="module")
def light() -> TexturedMesh:
    vertices, faces = icosphere(2)
    uvs = unwrapped(vertices, faces, SIZE)
    return TexturedMesh.from_mesh(vertices, faces, torch.zeros(SIZE, SIZE, 3), uvs)


def bumps() -> MeshFile:
    """A finer ball with waves."""
    vertices, faces = icosphere(5)
    return MeshFile(vertices * (1 + 0.02 * torch.sin(9 * vertices).prod(dim=1, keepdim=True)), faces)


def test_a_viewer_sees_the_normals_of_the_full_mesh(light: TexturedMesh) -> None:
    """Read as the specification says: the picture's three axes are the tangent, what is up in it, and the normal."""
    full = bumps()
    found = normal_map_of(light, full)
    vertices, faces = light.surface()
    covered, points, face = texel_points(vertices, faces, light.face_uvs, SIZE)
    weights = foot_weights(points, vertices[faces[face]]).float()[..., None]
    normal = torch.nn.functional.normalize((weights * found.normals[face]).sum(dim=1), dim=1)
    tangent = torch.nn.functional.normalize((weights * found.tangents[face][..., :3]).sum(dim=1), dim=1)
    bitangent = found.tangents[face][:, 0, 3:] * torch.linalg.cross(normal, tangent)
    x, y, z = (2 * found.pixels[covered].float() / 255 - 1).unbind(1)
    seen = torch.nn.functional.normalize(x[:, None] * tangent + y[:, None] * bitangent + z[:, None] * normal, dim=1)
    nearest = torch.cdist(points, full.vertices).argmin(dim=1)
    wanted = vertex_normals(full.vertices, full.faces)[nearest]
    angles = (seen * wanted).sum(dim=1).clamp(-1, 1).acos()
    unchanged = (normal * wanted).sum(dim=1).clamp(-1, 1).acos()
    assert float(unchanged.mean()) > 0.05
    assert float(angles.mean()) < 0.3 * float(unchanged.mean())


def test_where_both_are_alike_it_is_flat(light: TexturedMesh) -> None:
    """Also between charts, where the picture goes on as at their rims."""
    vertices, faces = light.surface()
    found = normal_map_of(light, MeshFile(vertices, faces.long()))
    assert int((found.pixels.int() - torch.tensor([128, 128, 255])).abs().max()) <= 1


def test_what_lies_behind_a_thin_wall_is_not_taken(light: TexturedMesh) -> None:
    """A full mesh that is inside out turns nothing."""
    vertices, faces = light.surface()
    found = normal_map_of(light, MeshFile(vertices, faces.long().flip(1)))
    assert int((found.pixels.int() - torch.tensor([128, 128, 255])).abs().max()) <= 1
