"""Depth maps of a ball, from all sides: what is in front of them is free, what is behind is not known."""

import pytest
import torch

from etsplat.data.free_space import TRUNCATED, free_space
from etsplat.data.photograph import photograph
from etsplat.data.visual_hull import visual_hull
from etsplat.geometry.icosphere import icosphere
from etsplat.io.mesh_files import MeshFile
from etsplat.ops.rasterize_opaque import rasterize_opaque

RADIUS = 0.85
"""Of the ball that the maps show, within the one of radius 1 that the silhouettes do."""


@pytest.fixture(scope="module")
def shown():
    """Views of a ball, and depth maps of a smaller one."""
    vertices, faces = icosphere(4)
    views = photograph(MeshFile(vertices, faces), 64, 64, supersampling=1)
    maps = {}
    for view in views.train:
        drawn = rasterize_opaque(RADIUS * vertices, faces=faces, cameras=views.cameras[view])
        maps[view] = drawn.depth[0, ..., 0]
    return views, maps


def along(direction: torch.Tensor, *radii: float) -> torch.Tensor:
    return torch.stack([radius * direction / direction.norm() for radius in radii])


def test_what_is_in_front_is_free_by_how_far_it_is(shown):
    """In the mean over views that look at a slant, too, so by more than the way to the surface."""
    free = free_space(*shown)
    found = free(along(torch.tensor([0.3, 0.5, -0.4]), 1.0, 0.9, 0.87, 0.83, 0.8, 0.3))
    assert found[0] == pytest.approx(TRUNCATED)
    assert 0.05 < found[1] <= TRUNCATED
    assert 0.015 < found[2] < 0.06
    assert -0.06 < found[3] < 0.0
    assert found[4] < -0.04
    assert found[5] == -TRUNCATED


def test_one_map_alone_does_not_tell(shown):
    views, maps = shown
    point = along(torch.tensor([0.3, 0.5, -0.4]), 0.93)
    first, second = sorted(maps, key=lambda view: -float(views.cameras[view].centers[0] @ point[0]))[:2]
    assert float(free_space(views, {first: maps[first]})(point)) == pytest.approx(-TRUNCATED)
    assert float(free_space(views, {first: maps[first], second: maps[second]})(point)) > 0
    unknown = {view: torch.zeros_like(depths) for view, depths in maps.items()}
    assert float(free_space(views, unknown)(point)) == pytest.approx(-TRUNCATED)


def test_a_hull_is_cut_where_space_is_free(shown):
    """By so much in front of what the maps show."""
    views, maps = shown
    free = free_space(views, maps)
    vertices, faces = visual_hull(views, 2000, free=lambda points: free(points) - 0.05)
    whole, _ = visual_hull(views, 2000)
    assert float(whole.norm(dim=1).min()) > 0.95
    radii = vertices.norm(dim=1)
    assert len(faces) > 500
    assert RADIUS < float(radii.median()) < RADIUS + 0.05
    assert float(radii.min()) > RADIUS - 0.05
    assert float(radii.max()) < RADIUS + 0.1
