"""Flat surfaces are found among points, the largest first, if cameras look down at them."""

import math

import pytest
import torch

from etsplat.data.support_planes import Plane, support_planes


def patch(count, normal, middle, size, noise, rng):
    """Points of a square patch around a point, and their normals."""
    normal = torch.nn.functional.normalize(torch.tensor(normal, dtype=torch.float64), dim=0)
    along = torch.nn.functional.normalize(torch.linalg.cross(normal, torch.tensor([0.3, 0.5, 0.7]).double()), dim=0)
    across = torch.linalg.cross(normal, along)
    u, v, w = (torch.randn(count, 1, generator=rng).double() if k == 2 else _flat(count, rng) for k in range(3))
    points = torch.tensor(middle).double() + size * (u * along + v * across) + noise * w * normal
    return points, normal.expand(count, 3)


def _flat(count, rng):
    return 2 * torch.rand(count, 1, generator=rng).double() - 1


def eyes(height):
    angles = torch.arange(12) * (math.pi / 6)
    return torch.stack([3 * angles.cos(), 3 * angles.sin(), torch.full((12,), height)], dim=1).double()


@pytest.mark.parametrize("noise", [0.0, 0.004])
def test_a_table_comes_before_a_smaller_box_on_it(noise):
    rng = torch.Generator().manual_seed(0)
    table = patch(3000, (0.1, 0.0, 1.0), (0.0, 0.0, -0.2), 1.0, noise, rng)
    lid = patch(900, (0.1, 0.0, 1.0), (0.0, 0.0, 0.4), 0.3, noise, rng)
    points, normals = (torch.cat(each) for each in zip(table, lid, strict=True))
    first, second, *_ = support_planes(points, normals, eyes(2.0), 1.5)
    expected = torch.nn.functional.normalize(torch.tensor([0.1, 0.0, 1.0]).double(), dim=0)
    for plane, height in ((first, -0.2), (second, 0.4)):
        assert float(plane.normal @ expected) > math.cos(math.radians(1))
        assert abs(float(plane.heights(torch.tensor([[0.0, 0.0, height]]).double()))) < 0.01
        assert abs(plane.spread - noise) < 0.3 * noise + 1e-12


def test_what_cameras_see_from_both_sides_is_none_that_something_stands_on():
    """A pane that most of the points are of, with cameras all around it."""
    rng = torch.Generator().manual_seed(1)
    pane = patch(3000, (1.0, 0.0, 0.0), (0.0, 0.0, 0.5), 1.0, 0.002, rng)
    floor = patch(500, (0.0, 0.0, 1.0), (0.0, 0.0, -1.0), 1.0, 0.002, rng)
    points, normals = (torch.cat(each) for each in zip(pane, floor, strict=True))
    found = list(support_planes(points, normals, eyes(0.5), 1.5))
    assert [round(float(plane.point[2])) for plane in found[:1]] == [-1]
    assert all(float(plane.normal[2]) > 0.9 for plane in found)


def test_few_points_are_no_plane():
    points = torch.zeros(2, 3).double()
    assert list(support_planes(points, points, eyes(1.0), 1.0)) == []


def test_feet_and_heights():
    plane = Plane(torch.tensor([0.0, 0.0, 1.0]).double(), torch.tensor([5.0, 5.0, 2.0]).double(), 0.0)
    points = torch.tensor([[1.0, 2.0, 3.5], [0.0, 0.0, 0.0]]).double()
    assert plane.heights(points).tolist() == [1.5, -2.0]
    assert plane.feet(points).tolist() == [[1.0, 2.0, 2.0], [0.0, 0.0, 2.0]]
