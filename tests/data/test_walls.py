"""Mugs, of whose hollow photos see the walls at a slant: how thick these are is found."""

from dataclasses import replace

import pytest
import torch

from etsplat.data.hollows import open_hollows
from etsplat.data.visual_hull import visual_hull
from etsplat.data.walls import between_walls
from etsplat.geometry.distance import closest_points
from etsplat.geometry.parts import Shape, shape_of
from helpers.painting import painted_pictures
from helpers.revolved import CAN, MUG, MUG_WALL, revolved

FACES = 4000


@pytest.fixture(scope="module")
def mug():
    """A mug in few photos, which push no lid in, and its hull."""
    vertices, faces, views = painted_pictures(*revolved(MUG))
    views = replace(views, train=views.train[::2])
    return (vertices, faces), views, visual_hull(views, FACES)


def test_what_is_free_lies_between_walls_of_their_true_thickness(mug) -> None:
    _, views, hull = mug
    assert open_hollows(views, *hull).contradicted > 0.01
    beyond = between_walls(views, *hull)
    assert beyond is not None
    heights = torch.tensor([[0.0, y, 0.0] for y in (-0.1, 0.1, 0.3)])
    wall = 0.5 - beyond(views.normalization.apply(heights)) * views.normalization.radius
    assert float((wall - MUG_WALL).abs().max()) < 0.02
    assert float(beyond(views.normalization.apply(torch.tensor([[0.5 - MUG_WALL / 3, 0.0, 0.0]])))) < 0


def test_a_hull_cut_out_between_walls_is_near_the_surface(mug) -> None:
    truth, views, hull = mug
    vertices, faces = visual_hull(views, 2 * FACES, free=between_walls(views, *hull))
    assert shape_of(vertices, faces) == Shape(1, 0)
    before, after = (closest_points(truth[0], *each)[0].mean() for each in (hull, (vertices, faces)))
    assert after < before / 5


def test_what_is_no_hollow_has_no_walls() -> None:
    _, _, views = painted_pictures(*revolved(CAN))
    assert between_walls(views, *visual_hull(views, FACES)) is None


def test_a_hollow_of_one_colour_has_no_walls() -> None:
    """Nothing says where they are."""
    _, _, views = painted_pictures(*revolved(MUG), painted=False)
    assert between_walls(views, *visual_hull(views, FACES)) is None
