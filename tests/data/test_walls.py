"""Mugs, of whose hollow photos see the walls at a slant: how thick these are is found."""

import math
from dataclasses import replace

import pytest
import torch
import trimesh
from torch.nn.functional import normalize

from etsplat.data.agreement import looked_at
from etsplat.data.hollows import open_hollows
from etsplat.data.photograph import photograph
from etsplat.data.photos import pixel_size
from etsplat.data.same_colors import local_sameness
from etsplat.data.through_lids import ThroughLid, _elsewhere
from etsplat.data.visual_hull import visual_hull
from etsplat.data.walls import _may_reach, _Walls, _walls, _with_level, between_plain_walls, between_walls
from etsplat.geometry.distance import closest_points
from etsplat.geometry.icosphere import icosphere
from etsplat.geometry.measures import area_normals
from etsplat.geometry.parts import Shape, shape_of
from etsplat.io.mesh_files import MeshFile
from helpers.painting import painted_pictures
from helpers.revolved import BOWL, CAN, MUG, MUG_WALL, revolved

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


def test_a_bottom_may_be_thicker_than_walls() -> None:
    """Three times so, in a bowl: its floor is at -0.2."""
    _, _, views = painted_pictures(*revolved(BOWL))
    beyond = between_walls(views, *visual_hull(views, FACES))
    assert beyond is not None
    heights = torch.tensor([[0.2, y, 0.0] for y in (-0.26, -0.14)])
    assert (beyond(views.normalization.apply(heights)) > 0).tolist() == [False, True]
    sides = torch.tensor([[out, 0.1, 0.0] for out in (0.62, 0.54)])
    assert (beyond(views.normalization.apply(sides)) > 0).tolist() == [False, True]


def test_what_was_pushed_in_elsewhere_is_where_it_went() -> None:
    """And not the lid, with what was pushed in beside it, nor another lid that looks up: here along a chain."""
    vertices, edges = torch.zeros(11, 3), torch.stack([torch.arange(10), torch.arange(1, 11)], dim=1)
    pushed, level = vertices.clone(), torch.tensor([1.0, 1, 1, 1, 0, 0, -1, -1, 0, 1, 1])
    pushed[[1, 2, 3, 6, 7, 9, 10]] = 1
    found = _elsewhere(vertices, edges, torch.tensor([0, 1]), pushed, level)
    assert found[:, 0].tolist() == [0, 0, 0, 0, 0, 0, 1, 1, 0, 0, 0]


def test_walls_have_no_brim() -> None:
    """Right under a lid all is free up to a wall's thickness from the sides, and what is under the rim stays."""
    vertices, faces = revolved(CAN)
    middles = vertices[faces].mean(dim=1)
    top, out = middles[:, 1] > 0.399, middles[:, [0, 2]].norm(dim=1)
    walls = _Walls(vertices, faces[top & (out < 0.4)], faces[top & (out > 0.4)], faces[:0], faces[~top], 0.1, 0.1)
    places = torch.tensor([[0.35, 0.37, 0.0], [0.5, 0.37, 0.0], [0.5, 0.2, 0.0], [0.65, 0.2, 0.0], [0.0, -0.45, 0.0]])
    assert (walls.beyond(places) > 0).tolist() == [True, False, True, False, False]


def test_a_lid_goes_on_beside_where_photos_contradict_it_and_ends_at_walls() -> None:
    """Of two tenths: three pixels farther than a lid that is small, and nothing over the walls of one that is large."""
    vertices, faces, views = painted_pictures(*revolved(CAN))
    looked = looked_at(views, vertices, faces)
    assert looked is not None
    middles = vertices[faces].mean(dim=1)
    top, out = middles[:, 1] > 0.99 * float(vertices[:, 1].max()), middles[:, [0, 2]].norm(dim=1)
    outer = float(out.max())
    for radius, most in ((0.4, 0.4 * outer + 3 * pixel_size(looked.photos)), (0.95, outer - 0.2)):
        found = _walls(ThroughLid(looked, top & (out < radius * outer), vertices), 0.2, 0.2)
        reached = vertices[found.lid].mean(dim=1)[:, [0, 2]].norm(dim=1).max()
        assert most - 0.04 < float(reached) <= most


def test_a_hull_cut_out_between_walls_is_near_the_surface(mug) -> None:
    truth, views, hull = mug
    vertices, faces = visual_hull(views, 2 * FACES, free=between_walls(views, *hull))
    assert shape_of(vertices, faces) == Shape(1, 0)
    before, after = (closest_points(truth[0], *each)[0].mean() for each in (hull, (vertices, faces)))
    assert after < before / 5


def test_a_bail_over_the_hollow_is_none_of_its_lid() -> None:
    """Photos agree little on what is thin, and the bail grows out of the rim."""
    vertices, faces = revolved(MUG)
    ring = trimesh.creation.torus(0.5 - MUG_WALL / 2, 0.06, major_sections=48, minor_sections=12)
    around, rest = torch.from_numpy(ring.vertices).float() + torch.tensor([0, 0.55, 0]), torch.from_numpy(ring.faces)
    bail = rest[(around[rest][..., 1] > 0.55).all(dim=1)]
    _, _, views = painted_pictures(torch.cat([vertices, around]), torch.cat([faces, bail + len(vertices)]))
    beyond = between_walls(views, *visual_hull(views, FACES))
    assert beyond is not None
    angles = torch.linspace(0.2, 2.9, 12)
    middle = torch.stack([angles.cos(), angles.sin(), 0 * angles], dim=1) * (0.5 - MUG_WALL / 2)
    assert float(beyond(views.normalization.apply(middle + torch.tensor([0, 0.55, 0]))).max()) < 0
    assert float(beyond(views.normalization.apply(torch.tensor([[0.0, 0.2, 0.0]])))) > 0.2


@pytest.mark.parametrize(("best", "may"), [(0.64, False), (0.66, True), (0.0, True), (-0.1, False)])
def test_some_places_tell_where_walls_are_not_looked_for(best: float, may: bool) -> None:
    """Unless nothing is known of them (0)."""
    assert _may_reach(0.8, lambda pixels: best if pixels == 14 else min(best, 0)) == may


def test_what_is_no_hollow_has_no_walls() -> None:
    _, _, views = painted_pictures(*revolved(CAN))
    assert between_walls(views, *visual_hull(views, FACES)) is None


def test_a_hollow_of_one_colour_has_no_walls() -> None:
    """Nothing says where they are."""
    _, _, views = painted_pictures(*revolved(MUG), painted=False)
    hull = visual_hull(views, FACES)
    assert between_walls(views, *hull) is None
    assert between_plain_walls(views, *hull) is None


@pytest.mark.parametrize("tilt", [0.0, 0.5])
def test_shading_tells_how_thick_plain_walls_are(tilt: float) -> None:
    """White, in light from two sides, upright and tilted."""
    vertices, faces = revolved(MUG)
    turn = torch.tensor([[1, 0, 0], [0, math.cos(tilt), math.sin(tilt)], [0, -math.sin(tilt), math.cos(tilt)]])
    views = photograph(MeshFile(vertices @ turn, faces), 200, 200)
    hull = visual_hull(views, FACES)
    beyond = between_plain_walls(views, *hull)
    assert beyond is not None
    heights = torch.tensor([[0.0, y, 0.0] for y in (-0.1, 0.1, 0.3)]) @ turn
    wall = 0.5 - beyond(views.normalization.apply(heights)) * views.normalization.radius
    assert float((wall - MUG_WALL).abs().max()) < 0.025


def test_the_inner_side_of_an_open_sheet_is_no_wall() -> None:
    """White, of half a ball."""
    vertices, faces = icosphere(4)
    views = photograph(MeshFile(vertices, faces[(vertices[faces][..., 1] < 1e-6).all(dim=1)]), 200, 200)
    assert between_plain_walls(views, *visual_hull(views, FACES)) is None


def test_a_plain_lid_is_where_colours_differ_with_all_that_is_level() -> None:
    """Of a white mug: its middle is told by colours, and the rim is as level."""
    vertices, faces = revolved(MUG)
    views = photograph(MeshFile(vertices, faces), 200, 200)
    hull, closed = visual_hull(views, FACES)
    looked = looked_at(views, hull, closed)
    assert looked is not None
    middles, normals = hull[closed].mean(dim=1), normalize(area_normals(hull, closed), dim=1)
    top, out = normals[:, 1] > 0.75, middles[:, [0, 2]].norm(dim=1)
    same = local_sameness(looked)[closed].nan_to_num(1.0).mean(dim=1)
    middle = top & (out < 0.3 * out.max())
    assert float(same[middle].max()) < 0.3
    assert float(same[~top].median()) > 0.8
    level = _with_level(middle, hull, closed)
    assert level[top & (out < 0.9 * out.max())].all()
    assert not level[normals[:, 1] < 0.65].any()
