"""Where pictures of separate opaque triangles are wrong, and how these are halved there."""

import math

import pytest
import torch

from etsplat import intrinsics, look_at
from etsplat.core.cameras import Cameras
from etsplat.data.dataset import Dataset
from etsplat.data.pictures import StoredPictures
from etsplat.model.surroundings import Surroundings
from etsplat.model.triangle_mesh import TriangleMesh
from etsplat.ops.adam import Adam
from etsplat.optim.edit import apply_rows, halves_plan
from etsplat.optim.exposure import Exposure
from etsplat.optim.picture_errors import FaceErrors, PictureErrors
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


def photographed(mesh: TriangleMesh, photos: int = 2) -> Dataset:
    """Pictures of a mesh from one to eight places, as photos."""
    eyes = torch.tensor([[0.0, 0, 6], [0.3, 0, 6]]).repeat(4, 1) + torch.arange(8)[:, None] // 2 * 0.1
    eyes = eyes[:photos]
    viewmats = look_at(eyes, torch.zeros(3), torch.tensor([0.0, 1, 0]))
    cameras = Cameras(viewmats, intrinsics(45, SIZE, SIZE).expand(photos, 3, 3).clone(), SIZE, SIZE)
    pictures = mesh.render(cameras).color.detach().clamp(0, 1)
    stored = StoredPictures([(picture * 255).round().to(torch.uint8) for picture in pictures])
    return Dataset(viewmats.double(), cameras.Ks.double(), stored, list("abcdefgh")[:photos], list(range(photos)), [])


def errors_of(capture: Dataset, mesh: TriangleMesh) -> FaceErrors:
    return PictureErrors(capture, 48, torch.device("cpu"), torch.zeros(3), Exposure(NEVER))(mesh)


RATES = {"vertices": 1e-3, "colors": 1e-2}
GREY = torch.full((3, 3), 0.5)


def test_errors_are_those_of_the_pixels_in_which_a_face_is_the_nearest() -> None:
    """Outlines alone where colours are right; of a wrong one its squared difference times its pixels, at half the size;
    none of what is hidden."""
    capture = photographed(a_mesh(GREY))
    assert float(errors_of(capture, a_mesh(GREY)).wrong.max()) < 0.15
    wrong = GREY.clone()
    wrong[1], wrong[2] = 0.9, 0.0
    mesh = a_mesh(wrong)
    found = errors_of(capture, mesh).wrong
    half = capture.halved()
    nearest = mesh.render(Cameras(half.viewmats.float(), half.Ks.float(), SIZE // 2, SIZE // 2)).triangle
    assert nearest is not None
    expected = 3 * 0.4**2 * float((nearest == 1).sum())
    assert float(found[1]) == pytest.approx(expected, rel=0.15)  # borders are blended
    assert float(found[2]) == 0
    assert float(found[0]) < 0.05 * float(found[1])


def test_a_face_is_in_the_way_if_photos_show_what_is_behind_it() -> None:
    """The one before another of the right colour, where it has a wrong one; not where a single photo says so, nor one
    that is wrong with worse behind it, nor one that no photo shows."""
    fitting, before, behind = CORNERS
    covering = before + torch.tensor([0.0, 0, 1])
    shown = torch.stack([fitting, before, behind])
    white = torch.tensor([[0.2, 0.2, 0.2], [0.9, 0.9, 0.9], [0.5, 0.5, 0.5], [0.4, 0.1, 0.1]])

    def of(corners: torch.Tensor, colors: torch.Tensor) -> TriangleMesh:
        faces = torch.arange(3 * len(corners)).reshape(-1, 3)
        return TriangleMesh.from_mesh(
            corners.reshape(-1, 3),
            faces,
            colors=colors.repeat_interleave(3, dim=0),
            opacity=None,
            sigma=None,
            vertex_colored=True,
        )

    truth, mesh = of(shown, white[:3]), of(torch.cat([shown, covering[None]]), white)
    found = errors_of(photographed(truth), mesh)
    assert found.in_the_way.tolist() == [False, False, False, True]
    assert not errors_of(photographed(truth, photos=1), mesh).in_the_way.any()
    assert not errors_of(photographed(truth), of(shown, white[:3] * 0.8)).in_the_way.any()


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


def told(wrong: list[float], in_the_way: list[bool] | None = None, gained: list[float] | None = None) -> FaceErrors:
    """Of so many faces; none in the way, and nothing gained, where it is not said."""
    count = len(wrong)
    return FaceErrors(
        torch.tensor(wrong).double(),
        torch.tensor(in_the_way or [False] * count),
        torch.tensor(gained or [0.0] * count).double(),
    )


def test_the_most_wrong_triangles_are_halved_at_their_time() -> None:
    """As many as are said, and as there may be; those in which nothing is wrong stay whole, and no corner is shared."""
    mesh = a_mesh(GREY)
    strategy = HalveWhereWrong(
        {2: 4, 5: 90, 7: 90}, lambda mesh: told([1.0, 3.0, 0.0] + [0.0] * (mesh.count - 3)), {2: 2, 5: 9}
    )
    adam = Adam(mesh.parameters(), RATES)
    strategy.start(mesh, adam, 2, torch.Generator())
    assert [strategy.next_edit(i) for i in (1, 2, 3, 8)] == [2, 2, 5, NEVER]
    assert not strategy.edit(1)
    assert strategy.edit(2)
    assert mesh.count == 4
    assert torch.equal(mesh.faces.flatten(), torch.arange(12))
    assert torch.equal(mesh.vertices.detach().reshape(-1, 3, 3)[:2], CORNERS[[0, 2]])
    assert strategy.edit(5)
    assert mesh.count == 6  # two of four were wrong
    assert adam.parameters["vertices"] is mesh.vertices
    assert not strategy.edit(7)  # none of the most wrong are named, and photos agree on none


def test_besides_them_those_are_halved_that_photos_agree_to_halve() -> None:
    """By what is gained, after the most wrong, up to the limit; one of both kinds is halved once."""
    for most, first in ((6, []), (5, [1]), (4, [1, 2])):  # what stays, first in the order of rows
        mesh = a_mesh(GREY)
        errors = told([9.0, 1.0, 2.0], gained=[5.0, 3.0, 4.0])
        strategy = HalveWhereWrong({1: most}, lambda _, errors=errors: errors, {1: 1})
        strategy.start(mesh, Adam(mesh.parameters(), RATES), 2, torch.Generator())
        assert strategy.edit(1)
        assert mesh.count == most
        assert torch.equal(mesh.vertices.detach().reshape(-1, 3, 3)[: len(first)], CORNERS[first])
    mesh = a_mesh(GREY)
    strategy = HalveWhereWrong({1: 9}, lambda _: told([9.0, 1.0, 2.0], gained=[-1.0, 3.0, -2.0]), {})
    strategy.start(mesh, Adam(mesh.parameters(), RATES), 2, torch.Generator())
    assert strategy.edit(1)
    assert torch.equal(mesh.vertices.detach().reshape(-1, 3, 3)[:2], CORNERS[[0, 2]])
    assert mesh.count == 4


@pytest.mark.parametrize(("in_the_way", "first"), [([False, True, False], [0]), ([True, True, True], [0, 1])])
def test_what_is_in_the_way_is_removed_before_others_are_halved(in_the_way: list[bool], first: list[int]) -> None:
    """Others are halved in its place, with the moments of what stays; but a mesh is not left without a triangle."""
    mesh = a_mesh(GREY)
    errors = told([1.0, 9.0, 2.0], in_the_way)
    strategy, adam = HalveWhereWrong({1: 3}, lambda _: errors, {1: 0}), Adam(mesh.parameters(), RATES)
    adam.first_moments["vertices"][:3] = 7.0
    strategy.start(mesh, adam, 2, torch.Generator())
    assert strategy.edit(1) == (not all(in_the_way))
    assert mesh.count == 3
    assert torch.equal(mesh.vertices.detach().reshape(-1, 3, 3)[: len(first)], CORNERS[first])
    assert bool((adam.first_moments["vertices"][:3] == 7.0).all())
    assert adam.parameters["colors"] is mesh.colors


def test_the_backdrop_is_never_in_the_way() -> None:
    """Though black behind it would be less wrong than its colour; before a backdrop that is nearer it is."""
    truth = a_mesh(torch.zeros(3, 3))
    capture, mesh = photographed(truth), a_mesh(GREY)
    for radius, found in ((0.2, False), (9.0, True)):
        around = Surroundings(torch.zeros(3), radius)
        errors = PictureErrors(capture, 48, torch.device("cpu"), torch.zeros(3), Exposure(NEVER), around)(mesh)
        assert bool(errors.in_the_way[0]) == found


def test_photos_agree_to_halve_a_face_of_two_colours() -> None:
    """Seen by eight photos from different places; not one that has a colour."""
    colors = torch.full((9, 3), 0.5)
    mesh = a_mesh(GREY)
    adam = Adam({"vertices": mesh.vertices.detach().clone(), "colors": colors.clone()}, RATES)
    plan = halves_plan(mesh.vertices.detach(), colors, torch.tensor([0]))
    made, _ = apply_rows(plan, adam, {})
    tones = made["colors"].reshape(-1, 3, 3)
    tones[2], tones[3] = 0.1, 0.9
    truth = TriangleMesh.from_mesh(
        made["vertices"],
        torch.arange(12).reshape(4, 3),
        colors=tones.reshape(-1, 3),
        opacity=None,
        sigma=None,
        vertex_colored=True,
    )
    gained = errors_of(photographed(truth, photos=8), mesh).gained
    assert float(gained[0]) > 5
    assert float(gained[1:].max()) < 0.1 * float(gained[0])


def test_errors_are_of_pictures_as_the_photos_were_exposed() -> None:
    """What was learned of exposures explains what a photo is darker by."""
    truth = a_mesh(GREY)
    capture, exposure = photographed(truth), Exposure(NEVER)
    exposure.start(capture.train, 1, truth.vertices)
    exposure.learned = True
    errors = PictureErrors(capture, 48, torch.device("cpu"), torch.zeros(3), exposure)
    bright = a_mesh(GREY * 1.4)
    assert float(errors(bright).wrong.sum()) > 3
    with torch.no_grad():
        exposure.values[:, 0] = -math.log(1.4)
    assert float(errors(bright).wrong.sum()) < 0.3
