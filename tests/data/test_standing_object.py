"""What stands on a table is found by true depth maps of photos from all around."""

import math

import pytest
import torch

from etsplat.core.cameras import intrinsics, look_at
from etsplat.data.dataset import Dataset
from etsplat.data.pictures import StoredPictures
from etsplat.data.standing_object import find_standing, mask_of
from etsplat.geometry.icosphere import icosphere
from etsplat.ops.rasterize_opaque import rasterize_opaque

WIDTH, HEIGHT = 120, 90
UP = torch.tensor([0.0, 0.0, 1.0])


def ball(middle, radius):
    """Corners of a ball's faces."""
    vertices, faces = icosphere(3)
    return (vertices * radius + torch.tensor(middle))[faces]


def table(radius=1.6, height=0.0, sides=64):
    """Corners of the faces of a disc, which faces up."""
    angles = torch.arange(sides + 1) * (2 * math.pi / sides)
    rim = torch.stack([radius * angles.cos(), radius * angles.sin(), torch.full_like(angles, height)], dim=1)
    return torch.stack([torch.tensor([0.0, 0.0, height]).expand(sides, 3), rim[:-1], rim[1:]], dim=1)


def around(corners, *, elevations=(20.0, 45.0), azimuths=10, distance=4.0, aim=(0.0, 0.0, 0.3), moved=None):
    """A data set without colours and its true depth maps."""
    eyes = []
    for elevation in map(math.radians, elevations):
        for azimuth in (2 * math.pi * k / azimuths + elevation for k in range(azimuths)):
            flat = math.cos(elevation)
            eyes.append([flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)])
    viewmats = look_at(torch.tensor(eyes) * distance + torch.tensor(aim), torch.tensor(aim), UP)
    if moved is not None:  # world' = scale * R world + t
        rotation, shift, scale = moved
        corners = scale * corners @ rotation.T + shift
        turned = viewmats.clone()
        turned[:, :3, :3] = viewmats[:, :3, :3] @ rotation.T
        turned[:, :3, 3] = scale * viewmats[:, :3, 3] - turned[:, :3, :3] @ shift
        viewmats = turned
    count = len(viewmats)
    K = intrinsics(45.0, WIDTH, HEIGHT)
    black = StoredPictures([torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8)] * count)
    names = [f"{k:02d}" for k in range(count)]
    views = Dataset(viewmats.double(), K.double().expand(count, 3, 3), black, names, list(range(count)), [])
    depths = {}
    for view in range(count):
        drawn = rasterize_opaque(corners, cameras=views.cameras[view]).depth
        assert drawn is not None
        depths[view] = drawn[0, ..., 0]
    return views, depths


def shown(corners, views, view, own):
    """Where some of the faces are nearest in a view."""
    nearest = rasterize_opaque(corners, cameras=views.cameras[view]).triangle
    assert nearest is not None
    return (nearest[0] >= 0) & own[nearest[0].clamp_min(0).long()]


def worst_iou(parts, views, depths, own_parts):
    """Least intersection over union, over all views, with where these of the parts are seen."""
    found = find_standing(views, depths)
    assert found is not None
    corners = torch.cat(parts)
    own = torch.cat([torch.full((len(part),), index in own_parts) for index, part in enumerate(parts)])
    ious = []
    for view in range(len(views)):
        mask, truth = mask_of(found, views, view, depths[view]), shown(corners, views, view, own)
        ious.append(int((mask & truth).sum()) / int((mask | truth).sum()))
    return min(ious)


def test_a_ball_on_a_table_wherever_the_axes_point_and_however_long_the_unit_is():
    parts = [ball((0.1, 0.0, 0.35), 0.35), table(), table(6.0, -1.0)]
    angle = 1.1
    rotation = torch.tensor(
        [[1.0, 0.0, 0.0], [0.0, math.cos(angle), -math.sin(angle)], [0.0, math.sin(angle), math.cos(angle)]]
    )
    moved = (rotation, torch.tensor([3.0, -7.0, 2.0]), 20.0)
    for place in (None, moved):
        views, depths = around(torch.cat(parts), moved=place)
        corners = parts if place is None else [20.0 * part @ rotation.T + moved[1] for part in parts]
        assert worst_iou(corners, views, depths, {0}) > 0.93


def test_two_things_side_by_side_are_one_object_and_a_tile_is_none():
    """The tile is as low as the bumps of a cloth."""
    tile = table(0.25, 0.01) + torch.tensor([0.0, 0.9, 0.0])
    parts = [ball((-0.4, 0.0, 0.3), 0.3), ball((0.45, 0.1, 0.25), 0.25), table(), tile]
    views, depths = around(torch.cat(parts))
    assert worst_iou(parts, views, depths, {0, 1}) > 0.93


def test_what_photos_frame_in_part_is_not_the_object():
    """A second ball that stands at the rim, where half of the photos cut it off."""
    parts = [ball((0.0, 0.0, 0.3), 0.3), ball((1.9, 0.0, 0.5), 0.5), table(2.6)]
    views, depths = around(torch.cat(parts), distance=2.6)
    assert worst_iou(parts, views, depths, {0}) > 0.9


def test_noise_of_depths_makes_no_object_of_the_table():
    parts = [ball((0.1, 0.0, 0.35), 0.35), table(), table(6.0, -1.0)]
    views, depths = around(torch.cat(parts))
    rng = torch.Generator().manual_seed(0)
    noisy = {
        view: torch.where(depth > 0, depth * (1 + 0.003 * torch.randn(depth.shape, generator=rng)), 0.0)
        for view, depth in depths.items()
    }
    assert worst_iou(parts, views, noisy, {0}) > 0.85


@pytest.mark.parametrize("parts", [[table()], [ball((0.0, 0.0, 0.0), 0.6)]], ids=["nothing on it", "nothing below"])
def test_none_where_nothing_stands_on_anything(parts):
    views, depths = around(torch.cat(parts))
    assert find_standing(views, depths) is None
