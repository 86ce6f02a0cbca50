"""A bowl with painted walls: its hull has a flat lid, which the photos contradict."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from etsplat.data.agreement import contradicted, looked_at, looked_by, plain_share, settled
from etsplat.data.closed_hollows import closed_hollows
from etsplat.data.hollows import _BEND, _TEAR, _depths, _mistaken, _where_agreed, _without_unseen, open_hollows
from etsplat.data.meshing import dual_contour
from etsplat.data.photograph import photograph
from etsplat.data.photos import first_hits, photos_of
from etsplat.data.visual_hull import visual_hull
from etsplat.geometry.distance import closest_points
from etsplat.geometry.measures import face_areas
from etsplat.geometry.topology import MeshTopology
from etsplat.io.mesh_files import MeshFile
from etsplat.tasks.judgement import CLOSED, CONTRADICTED
from helpers.painting import mean_colors, painted_pictures
from helpers.revolved import BOWL, CAN, VASE, revolved


def pictures_of(profile: list[tuple[float, float]], *, painted: bool):
    """Vertices and faces in the frame of the views, and the views."""
    return painted_pictures(*revolved(profile), painted=painted)


@pytest.fixture(scope="module")
def bowl():
    """The bowl and its views, its hull, and that opened."""
    vertices, faces, views = pictures_of(BOWL, painted=True)
    hull = visual_hull(views, 1600)
    return vertices, faces, views, hull, open_hollows(views, *hull)


def contradicted_of(views, vertices, faces):
    return contradicted(looked_at(views, vertices, faces), mean_colors(views, vertices, faces))


def inner(views, vertices):
    """Vertices near the axis that look up, above the middle of the bottom's thickness."""
    points = views.normalization.invert(vertices)
    return (points[:, ::2].norm(dim=1) < 0.4) & (points[:, 1] > -0.4)


def test_a_lid_goes_down_to_the_bottom(bowl):
    truth, faces, views, (hull, _), (found, opened, moved, *_) = bowl
    lid = inner(views, hull)
    assert lid.sum() > 30
    assert views.normalization.invert(hull)[lid, 1].min() > 0.35  # it is closed before
    assert moved > 0.9 * lid.sum()
    assert bowl[-1].doubtful >= moved / len(found)
    assert bowl[-1].agreed > 0.5
    topology = MeshTopology.from_faces(opened, len(found))
    assert topology.is_closed()
    assert topology.is_manifold()
    assert topology.is_oriented()
    depth = views.normalization.invert(found[: len(hull)])[lid, 1]
    assert depth.median() == pytest.approx(-0.2, abs=0.03)
    assert (depth + 0.2).abs().quantile(0.9) < 0.06
    before, after = (closest_points(points, truth, faces)[0].square().mean() for points in (hull, found))
    assert after < before / 10


def test_photos_agree_on_what_has_settled_and_not_on_a_lid(bowl):
    _, _, views, (hull, faces), (found, opened, *_) = bowl
    part, lid = settled(views), inner(views, hull)
    before, after = part(hull, faces), part(found, opened)
    assert float(before.min()) >= 0
    assert float(before.max()) <= 1
    assert float(before[lid].mean()) < 0.1
    assert float(after[: len(hull)][lid].mean()) > 0.9
    assert float(before[~lid].mean()) > 0.6


def test_the_side_which_is_no_lid_stays(bowl):
    _, _, views, (hull, _), (found, *_) = bowl
    points = views.normalization.invert(hull)
    side = (points[:, ::2].norm(dim=1) > 0.66) & (points[:, 1] > -0.4) & (points[:, 1] < 0.3)
    assert side.sum() > 100
    assert torch.equal(found[: len(hull)][side], hull[side])


def test_a_shallow_lid_over_a_flat_end_is_taken_off():
    """No camera looks along the ends of the can, so its hull is domed there, and nothing lies deeper."""
    truth, faces, views = pictures_of(CAN, painted=True)
    hull, triangles = visual_hull(views, 1600)
    found, _, moved, *_ = open_hollows(views, hull, triangles)
    assert moved > 100
    before, after = (closest_points(points, truth, faces)[0] for points in (hull, found))
    assert after.square().mean() < before.square().mean() / 4
    assert after.max() <= before.max()


def test_what_photos_contradict_is_measured(bowl):
    """A lid, until it is opened; the lid of a vase, into whose neck too few photos look, after that too."""
    truth, faces, views, hull, opened = bowl
    lid = math.pi * 0.58**2 / float(face_areas(views.normalization.invert(hull[0]), hull[1]).sum())
    assert contradicted_of(views, *hull) == pytest.approx(lid, abs=0.04)
    assert contradicted_of(views, opened.vertices, opened.faces) < CONTRADICTED / 2
    assert opened.contradicted < CONTRADICTED
    assert contradicted_of(views, truth, faces) < CONTRADICTED / 2
    _, _, views = pictures_of(VASE, painted=True)
    vase = open_hollows(views, *visual_hull(views, 1600))
    assert vase.contradicted > CONTRADICTED
    assert contradicted_of(views, vase.vertices, vase.faces) == pytest.approx(vase.contradicted, abs=0.01)


def test_how_much_of_a_hollow_is_closed_is_measured(bowl):
    truth, faces, views, hull, opened = bowl
    closed = closed_hollows(views, (truth, faces), hull)
    assert closed > 5 * CLOSED
    assert closed_hollows(views, (truth, faces), (opened.vertices, opened.faces)) < closed / 5
    assert closed_hollows(views, (truth, faces), (truth, faces)) == 0


def test_where_there_is_no_texture_nothing_moves(bowl):
    """And that nothing there is compared is known, since nobody would notice that a hollow is closed."""
    _, _, views = pictures_of(BOWL, painted=False)
    hull, triangles = visual_hull(views, 400)
    opened = open_hollows(views, hull, triangles)
    assert opened.moved == 0
    assert opened.agreed < 0.2
    assert plain_share(looked_at(views, hull, triangles)) > 0.8
    _, _, views, painted, _ = bowl
    assert plain_share(looked_at(views, *painted)) < 0.01


def cage(places: np.ndarray) -> np.ndarray:
    """The edges of a cube, as bars."""
    x, y, z = np.abs(places).T
    bars = [np.maximum(np.hypot(a - 0.7, b - 0.7) - 0.1, c - 0.7) for a, b, c in ((x, y, z), (y, z, x), (z, x, y))]
    return np.minimum.reduce(bars)


def test_plain_bars_on_which_photos_agree_nowhere_stay():
    """Their shading correlates by chance at some depth, which nobody would see."""
    vertices, faces = dual_contour(cage, (-1.25, -1.25, -1.25), 0.05, (50, 50, 50))
    views = photograph(MeshFile(torch.from_numpy(vertices).float(), torch.from_numpy(faces)), 160, 160, supersampling=2)
    hull = visual_hull(views, 1600)
    found, _, moved, *_ = open_hollows(views, *hull)
    assert moved == 0
    assert torch.equal(found, hull[0])


@pytest.mark.parametrize(("inwards", "mistaken"), [(False, False), (True, True)])
def test_what_silhouettes_need_is_no_lid(bowl, inwards, mistaken):
    """The upper end of a bowl's wall, where it is and pushed down, which uncovers a few pixels of each silhouette."""
    truth, faces, views, *_ = bowl
    photos = photos_of(views)
    hits = [first_hits(photo, truth, faces) for photo in photos]
    edges = MeshTopology.from_faces(faces, len(truth)).edges.long()
    height = views.normalization.invert(truth)[:, 1]
    rim = height > 0.39
    moved = truth.clone()
    moved[rim, 1] -= 0.06 * float(inwards)
    score = torch.zeros(len(truth))
    assert bool(_mistaken(photos, hits, score, moved, faces, score, rim, edges).any()) is mistaken


def test_what_photos_agree_on_no_better_once_it_is_open_is_no_lid(bowl):
    """On ribs that repeat photos agree a rib too deep as well."""
    truth, faces, views, *_ = bowl
    photos = photos_of(views)
    looked = looked_by(photos, truth, faces)
    hits, score, edges = looked.hits, looked.score, looked.topology.edges.long()
    deep = score > 0.8
    assert deep.float().mean() > 0.3
    for before, way, mistaken in ((score, 0.12, True), (score - 0.3, 0.12, False), (score, 0.05, False)):
        far = torch.full_like(score, way)
        assert bool(_mistaken(photos, hits, before, truth, faces, far, deep, edges)[deep].all()) is mistaken


def ribbed(places: np.ndarray) -> np.ndarray:
    """A column with ten ribs."""
    x, y, z = places.T
    return np.maximum(np.hypot(x, z) - 0.28 - 0.03 * np.cos(10 * np.arctan2(z, x)), np.abs(y) - 0.9)


def test_ribs_stay_where_they_are():
    """A cactus: its trunk was pushed in all around, three times as far off as its hull."""
    vertices, faces = (torch.from_numpy(each) for each in dual_contour(ribbed, (-1.2, -1.2, -1.2), 0.04, (60, 60, 60)))
    views = photograph(MeshFile(vertices.float(), faces), 160, 160, supersampling=2)
    hull, triangles = visual_hull(views, 1600)
    assert open_hollows(views, hull, triangles).moved < 0.05 * len(hull)


def test_it_repeats_to_the_bit(bowl):
    views = bowl[2]
    few = replace(views, train=views.train[::2])
    hull = visual_hull(few, 400)
    first, second = (open_hollows(few, *hull) for _ in range(2))
    assert first.moved > 0
    assert torch.equal(first[0], second[0])
    assert torch.equal(first[1], second[1])


def grid_links(side: int) -> torch.Tensor:
    """Edges of a square of vertices."""
    number = torch.arange(side * side).reshape(side, side)
    pairs = [(number[:, 1:], number[:, :-1]), (number[1:], number[:-1])]
    return torch.cat([torch.stack([a.flatten(), b.flatten()], dim=1) for a, b in pairs])


def test_a_hollow_is_not_much_deeper_than_it_is_wide():
    """Photos that agree far below a small lid show something else: its bottom would be out of sight."""
    side, agreed = 6, torch.full((36, 40), 0.9)
    for depth, opens in ((8, True), (11, True), (13, False), (39, False)):
        found = _where_agreed(torch.full((36,), depth), agreed, grid_links(side), 1.0)
        assert bool((found > 0).all()) is opens
        assert bool((found > 0).any()) is opens


@pytest.mark.parametrize(
    ("side", "on_the_lid", "behind", "opened"),
    [(12, 0.25, 0.6, True), (12, 0.5, 0.6, False), (12, 0.25, 0.5, False), (6, 0.25, 0.6, False), (6, 0.25, 0.8, True)],
)
def test_photos_agree_behind_a_lid_well_or_much_better_than_on_it(
    side: int, on_the_lid: float, behind: float, opened: bool
) -> None:
    """Much better is enough for wide lids alone: on a few vertices photos agree by chance."""
    found = torch.full((side * side, 10), 0.3)
    found[:, 0], found[:, 5] = on_the_lid, behind
    depth = torch.full((side * side,), 5)
    assert torch.equal(_where_agreed(depth, found, grid_links(side), 1.0) > 1, torch.full((side * side,), opened))


def test_a_shaft_in_a_wide_hollow_goes_hardly_deeper_than_the_hollow() -> None:
    side = 12
    depth = torch.full((side, side), 5)
    depth[4:8, 4:8] = 9
    hollow = depth.flatten().clone()
    depth[5, 5:7] = 20
    agreed = torch.full((side * side, 40), 0.9)
    assert torch.equal(_where_agreed(hollow, agreed, grid_links(side), 1.0), hollow)
    without = _where_agreed(depth.flatten(), agreed, grid_links(side), 1.0)
    assert torch.equal(without.clamp_max(9), hollow)
    assert 9 <= int(without.max()) <= 12


def test_what_photos_would_not_see_goes_no_deeper_than_what_is_beside_it():
    """A line of five vertices of a lid, the ends of which have a neighbour beside it."""
    links = torch.tensor([[0, 1], [1, 2], [2, 3], [3, 4]])
    way, neighbours = torch.tensor([0.2, 0.2, 0.9, 0.4, 0.4]), torch.full((5,), 2)
    seen = torch.ones(3, 5, dtype=torch.bool)
    assert torch.equal(_without_unseen(way, seen, neighbours, links), way)
    seen[1:, 2] = False
    expected = torch.tensor([0.2, 0.2, 0.3, 0.4, 0.4])
    torch.testing.assert_close(_without_unseen(way, seen, neighbours, links), expected)
    assert _without_unseen(way, torch.zeros_like(seen), neighbours, links).abs().max() == 0


def test_depths_have_the_least_cost_there_is_on_a_chain() -> None:
    """Against all choices: on a chain belief propagation is exact, whatever tears. Some depths are not allowed."""
    generator = torch.Generator().manual_seed(3)
    for _ in range(20):
        cost = torch.rand(5, 7, generator=generator)
        cost[:, 2:] = cost[:, 2:].masked_fill(torch.rand(5, 5, generator=generator) < 0.2, torch.inf)
        edges = torch.tensor([[0, 1], [2, 1], [2, 3], [3, 4]])
        every = torch.cartesian_prod(*[torch.arange(7)] * 5)
        steps = (every[:, edges[:, 0]] - every[:, edges[:, 1]]).abs()
        total = cost[torch.arange(5), every].sum(dim=1) + (_BEND * steps).clamp_max(_TEAR).sum(dim=1)
        assert torch.equal(_depths(cost, edges), every[total.argmin()])
