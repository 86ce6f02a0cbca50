"""Tangents of meshes under textures."""

import pytest
import torch

from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.measures import vertex_normals
from etsplat.geometry.tangents import corner_tangents

SQUARE = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
FACES = torch.tensor([[0, 1, 2], [0, 2, 3]])
UP = torch.tensor([[0.0, 0, 1]]).expand(4, 3)


def test_of_a_square_that_lies_in_its_texture_as_a_picture_does() -> None:
    """+x is to the right and +y up in the picture: the tangent is +x, the other axis +y; turned, it turns along."""
    uvs = torch.stack([SQUARE[:, 0], 1 - SQUARE[:, 1]], dim=1)[FACES]
    found = corner_tangents(SQUARE, FACES, UP, uvs)
    assert torch.allclose(found, torch.tensor([1.0, 0, 0, 1]).expand(2, 3, 4), atol=1e-6)
    turned = torch.stack([uvs[..., 1], 1 - uvs[..., 0]], dim=-1)  # what was above is to the left: u grows downwards
    found = corner_tangents(SQUARE, FACES, UP, turned)
    assert torch.allclose(found, torch.tensor([0.0, -1, 0, 1]).expand(2, 3, 4), atol=1e-6)


def test_of_a_mirrored_square() -> None:
    """u grows against x: the sign says that the third axis is still up."""
    uvs = torch.stack([1 - SQUARE[:, 0], 1 - SQUARE[:, 1]], dim=1)[FACES]
    found = corner_tangents(SQUARE, FACES, UP, uvs)
    assert torch.allclose(found, torch.tensor([-1.0, 0, 0, -1]).expand(2, 3, 4), atol=1e-6)


def test_on_a_curved_mesh_they_follow_the_texture() -> None:
    """Perpendicular to the normals, of unit length, the same where corners meet; u grows and v falls along the axes."""
    vertices, faces = icosphere(3)
    normals = vertex_normals(vertices, faces)
    around = torch.atan2(vertices[:, 1], vertices[:, 0])[faces]
    kept = (around.amax(dim=1) - around.amin(dim=1) < 1) & (vertices[faces][..., 2].abs().amax(dim=1) < 0.8)
    faces = faces[kept]
    uvs = torch.stack([0.5 + around[kept] / 8, 0.5 - vertices[faces][..., 2] / 2], dim=-1)
    found = corner_tangents(vertices, faces, normals, uvs)
    tangent, sign, normal = found[..., :3], found[..., 3:], normals[faces]
    assert torch.allclose(tangent.norm(dim=-1), torch.ones(tangent.shape[:2]), atol=1e-5)
    assert float((tangent * normal).sum(dim=-1).abs().max()) < 1e-5
    points = vertices[faces]
    east = torch.nn.functional.normalize(
        torch.stack([-points[..., 1], points[..., 0], 0 * points[..., 0]], dim=-1), dim=-1
    )
    assert float((tangent * east).sum(dim=-1).min()) > 0.97
    assert float((sign * torch.linalg.cross(normal, tangent))[..., 2].min()) > 0.4  # towards the pole, as 1 - v grows
    by_vertex = torch.zeros(len(vertices), 4).index_put((faces.reshape(-1),), found.reshape(-1, 4))
    assert torch.equal(by_vertex[faces], found)


def test_where_the_texture_has_no_direction() -> None:
    """Of faces without area in the texture tangents are any unit vectors perpendicular to the normals."""
    found = corner_tangents(SQUARE, FACES, UP, torch.full((2, 3, 2), 0.3))
    assert torch.allclose(found[..., :3].norm(dim=-1), torch.ones(2, 3), atol=1e-6)
    assert float(found[..., 2].abs().max()) < 1e-6


def test_wrong_arguments_are_named() -> None:
    for position, wrong in ((0, SQUARE[:, :2]), (1, FACES[:, :2]), (1, FACES + 2), (2, UP[:3]), (3, torch.zeros(2, 3))):
        arguments = [SQUARE, FACES, UP, torch.zeros(2, 3, 2)]
        arguments[position] = wrong
        with pytest.raises(ValueError, match=("vertices", "faces", "normals", "face_uvs")[position]):
            corner_tangents(*arguments)
