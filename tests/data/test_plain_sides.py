"""Plain solids: their hulls stand over flat sides like tents, which no photo contradicts."""

import itertools
from dataclasses import replace

import pytest
import torch
from torch.nn.functional import max_pool2d

from etsplat.core.cameras import camera_centers
from etsplat.data.false_handles import silhouette_errors
from etsplat.data.photos import first_hits, photos_of
from etsplat.data.plain_sides import with_flat_sides
from etsplat.data.visual_hull import outside_hull, visual_hull
from etsplat.geometry.distance import closest_points
from etsplat.geometry.films import held
from etsplat.geometry.topology import MeshTopology
from helpers.painting import painted_pictures

FACES = 4000


def box(parts: int = 8) -> tuple[torch.Tensor, torch.Tensor]:
    """A cube whose sides are grids of squares."""
    step = torch.arange(parts + 1) / parts * 2 - 1
    across, up = (grid.reshape(-1) for grid in torch.meshgrid(step, step, indexing="ij"))
    corner = torch.tensor([i * (parts + 1) + j for i, j in itertools.product(range(parts), repeat=2)])
    squares = torch.stack([corner, corner + parts + 1, corner + parts + 2, corner + 1], dim=1)
    vertices, faces = [], []
    for axis, side in itertools.product(range(3), (-1, 1)):
        places = torch.stack([torch.full_like(up, side), side * across, up], dim=1)
        faces.append(torch.cat([squares[:, [0, 1, 2]], squares[:, [0, 2, 3]]]) + sum(map(len, vertices)))
        vertices.append(places.roll(axis, dims=1))
    return torch.cat(vertices), torch.cat(faces)


@pytest.fixture(scope="module")
def plain():
    """The cube, views of it in one colour, and their hull."""
    vertices, faces, views = painted_pictures(*box(), painted=False)
    return (vertices, faces), views, visual_hull(views, FACES)


def heights(surface: tuple[torch.Tensor, torch.Tensor], truth: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
    """How far each vertex of a surface is from the true one."""
    return closest_points(surface[0], *truth)[0].sqrt()


def test_tents_over_plain_sides_go(plain) -> None:
    truth, views, (vertices, faces) = plain
    flat = with_flat_sides(views, vertices, faces)
    before, after = heights((vertices, faces), truth), heights((flat, faces), truth)
    assert float(before.max()) > 0.1
    assert float(after.max()) < 0.05
    assert float(after.square().mean()) < 0.1 * float(before.square().mean())


def test_silhouettes_stay(plain) -> None:
    _, views, (vertices, faces) = plain
    before = silhouette_errors(photos_of(views), vertices, faces)
    after = silhouette_errors(photos_of(views), with_flat_sides(views, vertices, faces), faces)
    assert float((after - before).max()) <= 1e-3


def test_vertices_move_inwards_only(plain) -> None:
    _, views, (vertices, faces) = plain
    flat = with_flat_sides(views, vertices, faces)
    moved = (flat != vertices).any(dim=1)
    assert float(moved.float().mean()) > 0.5
    assert float(outside_hull(views)(flat[moved]).max()) < 1e-3


def test_a_bottom_that_no_photo_sees_is_flat() -> None:
    """Photos from above alone: under the cube the hull is a cone. What photos see hides nothing of it afterwards."""
    vertices, _, views = painted_pictures(*box())
    above = [index for index in views.train if float(camera_centers(views.viewmats[index][None])[0, 1]) > 0.5]
    views = replace(views, train=above)
    hull = visual_hull(views, FACES)
    flat = with_flat_sides(views, *hull), hull[1]
    lowest = float(vertices[:, 1].min())
    assert float(hull[0][:, 1].min()) < lowest - 0.2
    assert float(flat[0][:, 1].min()) > lowest - 0.05
    for photo in photos_of(views):
        (before, _), (after, hit) = (first_hits(photo, *surface) for surface in (hull, flat))
        # At an outline a pixel may show what is on either side of it: of the surface before that is the nearest around.
        nearest = -max_pool2d(-torch.where(before > 0, before, torch.inf)[None, None], 3, stride=1, padding=1)[0, 0]
        assert float((nearest - after)[hit >= 0].max()) < 0.05


def test_what_photos_tell_apart_stays() -> None:
    _, _, views = painted_pictures(*box(16), painted=True)
    hull = visual_hull(views, FACES)
    assert torch.equal(with_flat_sides(views, *hull), hull[0])


def test_few_photos_move_nothing(plain) -> None:
    _, views, (vertices, faces) = plain
    assert torch.equal(with_flat_sides(replace(views, train=views.train[:1]), vertices, faces), vertices)


def test_borders_stay(plain) -> None:
    _, views, (vertices, faces) = plain
    open_below = faces[vertices[faces][:, :, 1].mean(dim=1) > -0.57]
    used = open_below.unique()
    flat = with_flat_sides(views, vertices, open_below)
    edges = MeshTopology.from_faces(open_below, len(vertices))
    border = edges.edges[edges.edge_face_counts == 1].long().reshape(-1)
    assert len(border) > 20
    assert torch.equal(flat[border], vertices[border])
    assert float((flat != vertices).any(dim=1)[used].float().mean()) > 0.3


def test_parts_that_nothing_holds_stay() -> None:
    edges = torch.tensor([[0, 1], [1, 2], [3, 4]])
    free = torch.tensor([True, True, False, True, True])
    assert held(free, edges).tolist() == [True, True, False, False, False]
