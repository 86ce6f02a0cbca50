"""Where pictures of separate opaque triangles are wrong, and how these are halved there."""

import pytest
import torch

from etsplat import intrinsics, look_at
from etsplat.core.cameras import Cameras
from etsplat.data.dataset import Dataset
from etsplat.data.pictures import StoredPictures
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.ops.adam import Adam
from etsplat.optim.edit import apply_rows, halves_plan
from etsplat.optim.picture_errors import PictureErrors
from etsplat.optim.schedules import NEVER
from etsplat.optim.strategies import HalveWhereWrong

SIZE = 32
# One to the left, one to the right, one behind the right one.
CORNERS = torch.tensor(
    [
        [[-2.0, -1, 0], [0, -1, 0], [-1, 1, 0]],
        [[0.0, -1, 0], [2, -1, 0], [1, 1, 0]],
        [[0.8, -0.7, -1], [1.3, -0.7, -1], [1, -0.2, -1]],
    ]
)


def a_mesh(colors: torch.Tensor) -> TriangleMesh:
    return TriangleMesh.from_mesh(
        CORNERS.reshape(-1, 3),
        torch.arange(9).reshape(3, 3),
        colors=colors.repeat_interleave(3, dim=0),
        opacity=None,
        sigma=None,
        vertex_colored=True,
    )


def photographed(mesh: TriangleMesh) -> Dataset:
    """Pictures of a mesh from two places, as photos."""
    eyes = torch.tensor([[0.0, 0, 6], [0.3, 0, 6]])
    viewmats = look_at(eyes, torch.zeros(3), torch.tensor([0.0, 1, 0]))
    cameras = Cameras(viewmats, intrinsics(45, SIZE, SIZE).expand(2, 3, 3).clone(), SIZE, SIZE)
    pictures = mesh.render(cameras).color.detach().clamp(0, 1)
    photos = StoredPictures([(picture * 255).round().to(torch.uint8) for picture in pictures])
    return Dataset(viewmats.double(), cameras.Ks.double(), photos, ["a", "b"], [0, 1], [])


RATES = {"vertices": 1e-3, "colors": 1e-2}
GREY = torch.full((3, 3), 0.5)


def test_errors_are_those_of_the_pixels_in_which_a_face_is_the_nearest() -> None:
    """None where colours are right; of a wrong one its squared difference times its pixels; none of what is hidden."""
    capture = photographed(a_mesh(GREY))
    errors = PictureErrors(capture, 48, torch.device("cpu"), torch.zeros(3))
    assert float(errors(a_mesh(GREY)).max()) < 0.01
    wrong = GREY.clone()
    wrong[1], wrong[2] = 0.9, 0.0
    mesh = a_mesh(wrong)
    found = errors(mesh)
    nearest = mesh.render(Cameras(capture.viewmats.float(), capture.Ks.float(), SIZE, SIZE)).triangle
    assert nearest is not None
    expected = 3 * 0.4**2 * float((nearest == 1).sum())
    assert float(found[1]) == pytest.approx(expected, rel=0.15)  # borders are blended
    assert float(found[2]) == 0
    assert float(found[0]) < 0.05 * float(found[1])


def test_halves_cover_what_was_halved_in_the_colours_that_it_had() -> None:
    """At the middle of the longest edge, which two corners get; the others, and rows of triangles that stay, stay."""
    colors = torch.rand(9, 3, generator=torch.Generator().manual_seed(0))
    vertices = torch.cat([CORNERS.reshape(-1, 3)])
    vertices[3:6] = torch.tensor([[0.0, 0, 0], [4, 0, 0], [0, 3, 0]])  # the longest edge is the second
    adam = Adam({"vertices": vertices.requires_grad_(True), "colors": colors.requires_grad_(True)}, RATES)
    plan = halves_plan(vertices.detach(), colors.detach(), torch.tensor([1]))
    made, _ = apply_rows(plan, adam, {})
    triangles, tones = made["vertices"].detach().reshape(-1, 3, 3), made["colors"].detach().reshape(-1, 3, 3)
    assert torch.equal(triangles[:2], CORNERS[[0, 2]])
    middle = torch.tensor([2.0, 1.5, 0])
    assert torch.equal(triangles[2], torch.stack([vertices[3], vertices[4], middle]).detach())
    assert torch.equal(triangles[3], torch.stack([vertices[3], middle, vertices[5]]).detach())
    torch.testing.assert_close(tones[2, 2], colors[4:6].detach().mean(dim=0))
    torch.testing.assert_close(tones[3, 1], colors[4:6].detach().mean(dim=0))


def test_the_most_wrong_triangles_are_halved_at_their_time() -> None:
    """As many as there may be; those in which nothing is wrong stay whole, and no corner is shared."""
    mesh = a_mesh(GREY)
    wrong = torch.tensor([1.0, 3.0, 0.0], dtype=torch.float64)
    strategy = HalveWhereWrong({2: 4, 5: 90}, lambda mesh: torch.cat([wrong, torch.zeros(mesh.count - 3)]))
    adam = Adam(mesh.parameters(), RATES)
    strategy.start(mesh, adam, 2, torch.Generator())
    assert [strategy.next_edit(i) for i in (1, 2, 3, 6)] == [2, 2, 5, NEVER]
    assert not strategy.edit(1)
    assert strategy.edit(2)
    assert mesh.count == 4
    assert torch.equal(mesh.faces.flatten(), torch.arange(12))
    assert torch.equal(mesh.vertices.detach().reshape(-1, 3, 3)[:2], CORNERS[[0, 2]])
    assert strategy.edit(5)
    assert mesh.count == 6  # two of four were wrong
    assert adam.parameters["vertices"] is mesh.vertices
