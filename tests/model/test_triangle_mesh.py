"""The mesh of shape reconstruction, where its colours depend on the direction."""

import pytest
import torch
from torch import Tensor

from etsplat.core.cameras import Cameras, intrinsics, look_at
from etsplat.geometry.icosphere import icosphere
from etsplat.model.triangle_mesh import TriangleMesh

VERTICES, FACES = icosphere(1)


def ball(harmonics: int) -> TriangleMesh:
    colors = torch.rand(len(FACES), 3, generator=torch.Generator().manual_seed(1))
    return TriangleMesh.from_mesh(VERTICES, FACES, colors=colors, opacity=0.9, sigma=0.1, harmonics=harmonics)


def cameras(eyes: Tensor, size: int = 40) -> Cameras:
    viewmats = look_at(eyes, torch.zeros(3), torch.tensor([0.1, 1, 0]))
    return Cameras(viewmats, intrinsics(40, size, size).expand(len(eyes), 3, 3), size, size)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_faces_whose_harmonics_are_zero_look_as_those_without(degree: int) -> None:
    """From any side, and where the mesh is written."""
    plain, glossy = ball(0), ball(degree)
    assert glossy.harmonics is not None
    assert glossy.harmonics.shape == (len(FACES), (degree + 1) ** 2 - 1, 3)
    assert glossy.degree == degree
    views = cameras(torch.tensor([[0.0, 0, 3], [2, 1, -2]]))
    torch.testing.assert_close(plain.render(views).color, glossy.render(views).color, atol=2e-6, rtol=0)
    torch.testing.assert_close(plain.display_colors, glossy.display_colors, atol=2e-6, rtol=0)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_a_written_face_has_its_mean_over_the_directions_in_front_of_it(degree: int, rng: torch.Generator) -> None:
    """Against its colours towards many cameras, each with the area that the face shows to it."""
    mesh = ball(degree)
    assert mesh.harmonics is not None
    mesh.colors.data[:] = 0.5
    mesh.harmonics.data[:] = 0.05 * torch.randn(mesh.harmonics.shape, generator=rng)
    corners = mesh.vertices.detach()[mesh.faces[7]]
    normal = torch.linalg.cross(corners[1] - corners[0], corners[2] - corners[0])
    directions = torch.nn.functional.normalize(torch.randn(40_000, 3, generator=rng), dim=1)
    shown = (directions @ torch.nn.functional.normalize(normal, dim=0)).clamp(min=0)
    eyes = corners.mean(dim=0) + 5 * directions
    seen = mesh._colors_towards(cameras(eyes))
    mean = (shown[:, None] * seen[:, 7].detach()).sum(dim=0) / shown.sum()
    torch.testing.assert_close(mesh.display_colors[7], mean, atol=2e-3, rtol=0)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_opaque_faces_are_drawn_in_the_colours_that_are_written(degree: int, rng: torch.Generator) -> None:
    """From every side, and gradients reach the constant part, of black faces too."""
    mesh = ball(degree)
    assert mesh.harmonics is not None
    mesh.harmonics.data[:] = 0.05 * torch.randn(mesh.harmonics.shape, generator=rng)
    mesh.colors.data[:] = 0.3 + 0.4 * mesh.colors.data
    plain = TriangleMesh.from_mesh(VERTICES, FACES, colors=mesh.display_colors, opacity=None, sigma=None)
    mesh.appearance = plain.appearance
    views = cameras(torch.tensor([[0.0, 0, 3], [2, 1, -2]]))
    drawn = mesh.render(views).color
    torch.testing.assert_close(drawn, plain.render(views).color, atol=2e-6, rtol=0)
    mesh.colors.data[:] = -0.5
    mesh.render(views).color.sum().backward()
    assert mesh.colors.grad is not None
    assert int((mesh.colors.grad[:, 0] > 0).sum()) > len(FACES) // 2


def test_gradients_reach_the_harmonics_and_subdivision_hands_them_on() -> None:
    """They are parameters with a row for each face."""
    mesh = ball(2)
    mesh.render(cameras(torch.tensor([[0.0, 0, 3]]))).color.square().sum().backward()
    assert mesh.harmonics is not None
    assert mesh.harmonics.grad is not None
    assert int((mesh.harmonics.grad.abs().sum(dim=(1, 2)) > 0).sum()) > len(FACES) // 4
    assert mesh.face_parameters == ("colors", "opacity_logits", "harmonics")


@pytest.mark.parametrize("given", [{"opacity": None, "sigma": None}, {"vertex_colored": True}])
def test_harmonics_of_other_colours_are_refused(given: dict[str, object]) -> None:
    arguments = {"colors": 0.5, "opacity": 0.9, "sigma": 0.1, "harmonics": 1, **given}
    with pytest.raises(ValueError, match="harmonics must be 0"):
        TriangleMesh.from_mesh(VERTICES, FACES, **arguments)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"colors": torch.rand(3, 3)}, r"colors must have shape \(F, 3\)"),
        ({"colors": torch.rand(len(FACES), 3), "vertex_colored": True}, r"colors must have shape \(V, 3\)"),
        ({"colors": 200.0}, "colors must be from 0 to 1, got 200"),
        ({"opacity": 1.0}, "opacity must be above 0 and below 1, got 1"),
        ({"opacity": torch.ones(3)}, r"opacity must be a number, got a tensor of shape \(3,\)"),
        ({"harmonics": -1}, "harmonics must be an integer from 0 to 3, got -1"),
        ({"harmonics": 1.0}, "harmonics must be an integer from 0 to 3"),
        ({"sigma": 0.0}, "sigma must be positive and finite, got 0"),
        ({"sigma": float("nan")}, "sigma must be positive and finite, got nan"),
        ({"sigma": None}, "opacity and sigma must be given together, or both be None"),
    ],
)
def test_a_mesh_that_could_not_be_drawn_is_refused_where_it_is_made(given: dict[str, object], message: str) -> None:
    arguments = {"colors": 0.5, "opacity": 0.9, "sigma": 0.1, **given}
    with pytest.raises(ValueError, match=message):
        TriangleMesh.from_mesh(VERTICES, FACES, **arguments)  # type: ignore[arg-type]
