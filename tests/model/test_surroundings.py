"""The sphere behind a capture: where it is, its colours, and that nothing shines through it."""

from dataclasses import replace

import pytest
import torch

from etsplat.data.dataset import Dataset
from etsplat.data.demo_scene import demo_scene
from etsplat.data.pictures import StoredPictures
from etsplat.model.soup_appearance import SoupAppearance
from etsplat.model.soup_init import StartPoints
from etsplat.model.surroundings import Surroundings
from etsplat.model.triangle_soup import TriangleSoup


@pytest.fixture(scope="module")
def capture() -> Dataset:
    return demo_scene(32, 24).normalized()


@pytest.fixture(scope="module")
def sphere(capture: Dataset) -> TriangleSoup:
    return Surroundings.of(capture).soup(capture, 1)


def test_it_surrounds_cameras_and_nearly_all_points(capture: Dataset, sphere: TriangleSoup) -> None:
    """A point that structure from motion put far away does not move it."""
    assert capture.exact_points is not None
    middle = capture.centers[capture.train].mean(dim=0).float()
    radius = (sphere.vertices.detach() - middle).norm(dim=-1)
    torch.testing.assert_close(radius, radius.mean().expand_as(radius), rtol=1e-4, atol=0)
    assert float((capture.centers.float() - middle).norm(dim=1).max()) < float(radius.min())
    stray = capture.exact_points.clone()
    stray[0] = 1e4
    again = Surroundings.of(replace(capture, exact_points=stray))
    assert again.radius == pytest.approx(Surroundings.of(capture).radius, rel=0.02)
    assert bool(again.outermost(sphere.vertices).all())
    assert not bool(again.outermost(0.8 * sphere.vertices.detach()).any())


def test_every_view_is_covered(capture: Dataset, sphere: TriangleSoup) -> None:
    """There is no gap, and about a third of the background shines through at the start."""
    for camera in capture.cameras[:3]:
        alpha = replace(sphere, appearance=SoupAppearance(near_plane=0.05)).render(camera).alpha.detach()
        assert float(alpha.mean()) > 0.6
        assert float(alpha.min()) > 0.4


def test_colours_are_those_of_the_photos_there_and_next_to_it(capture: Dataset) -> None:
    """Red photos make a red sphere, also where none shows it."""

    photo = torch.tensor([255, 0, 0], dtype=torch.uint8).repeat(24, 32, 1)
    red = replace(capture, images=StoredPictures([photo] * len(capture)))
    colors = Surroundings.of(red).soup(red, 0).display_colors()
    torch.testing.assert_close(colors, torch.tensor([[1.0, 0, 0]]).expand_as(colors), rtol=0, atol=1e-3)
    colors = Surroundings.of(red).backdrop(red)[1]
    torch.testing.assert_close(colors, torch.tensor([1.0, 0, 0]).expand_as(colors), rtol=0, atol=1e-3)


def test_a_backdrop_is_closed_behind_the_sphere(capture: Dataset) -> None:
    """Every edge belongs to two triangles; what is halved stays at it, and the sphere is not."""
    surroundings = Surroundings.of(capture)
    corners = surroundings.backdrop(capture)[0]
    edges = torch.cat([corners, corners.roll(-1, dims=1)], dim=-1).reshape(-1, 2, 3)
    count = edges.mean(dim=1).unique(dim=0, return_counts=True)[1]
    assert count.unique().tolist() == [2]
    assert bool(surroundings.at_backdrop(edges.mean(dim=1)).all())
    assert bool(surroundings.at_backdrop(corners.reshape(-1, 3)).all())
    sphere = surroundings.soup(capture, 0)
    assert not bool(surroundings.at_backdrop(sphere.vertices.detach().reshape(-1, 3)).any())
    assert bool(surroundings.outermost(corners).all())


def test_a_note_tells_the_sphere_to_the_last_bit(capture: Dataset) -> None:
    """What is no note of one tells none."""
    told = Surroundings.of(capture)
    again = Surroundings.of_note(told.note)
    assert again is not None
    assert again.radius == told.radius
    assert torch.equal(again.middle.float(), told.middle)
    for note in ("none", "", "1 2 3", "1 2 3 0", "1 2 nan 4", "1 2 3 x"):
        assert Surroundings.of_note(note) is None


def test_a_dome_is_about_the_origin_where_the_start_puts_it() -> None:
    points = StartPoints(torch.tensor([[0.5, -3.0, 1.0], [0.0, 0.0, 0.1]]).repeat(20, 1), torch.rand(40, 3))
    dome = points.with_sky().positions[:2, None].expand(2, 3, 3)
    told = Surroundings.dome(points.positions)
    assert bool(told.outermost(dome).all())
    assert told.radius == 3


def test_it_is_told_which_triangles_face_outwards(capture: Dataset, sphere: TriangleSoup) -> None:
    """Its own are seen from inside; turned around, they are not."""
    surroundings, vertices = Surroundings.of(capture), sphere.vertices.detach()
    a, b, c = vertices.unbind(dim=1)
    inwards = (torch.linalg.cross(b - a, c - a) * (surroundings.middle - vertices.mean(dim=1))).sum(dim=1) > 0
    mixed = torch.cat([vertices[:100].flip(1), vertices[100:]])
    assert torch.equal(surroundings.facing_outwards(vertices), ~inwards)
    assert torch.equal(surroundings.facing_outwards(mixed), torch.cat([inwards[:100], ~inwards[100:]]))
