"""Cameras on the lines through neighbouring ones: where they stand, what they look at, whose lens they have."""

import pytest
import torch
from torch import Tensor

from etsplat.core.cameras import camera_centers, look_at
from etsplat.data.cameras_beside import BEYOND, cameras_beside
from helpers.captures import circle_poses

UP = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def row(count: int) -> Tensor:
    """Cameras a unit apart along x, looking along z."""
    eyes = torch.zeros(count, 3, dtype=torch.float64)
    eyes[:, 0] = torch.arange(count)
    return look_at(eyes, eyes + torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), UP)


def test_they_stand_between_two_cameras_and_as_far_beyond_either() -> None:
    """Evenly along the line, looking where both look, each with the lens of the nearer one."""
    viewmats, nearest = cameras_beside(row(2), 4000, seeded())
    centers = camera_centers(viewmats)
    assert centers[:, 1:].abs().max() < 1e-12
    places = centers[:, 0]
    assert -BEYOND < float(places.min()) < -BEYOND + 0.01
    assert 1 + BEYOND - 0.01 < float(places.max()) < 1 + BEYOND
    parts = torch.histc(places.float(), bins=6, min=-BEYOND, max=1 + BEYOND)
    assert float(parts.min()) > 0.85 * 4000 / 6
    torch.testing.assert_close(viewmats[:, :3, :3], row(2)[:1, :3, :3].expand(4000, 3, 3))
    assert torch.equal(nearest, (places > 0.5).long())


def test_each_pair_of_neighbours_has_its_share_and_turns_with_them() -> None:
    """About a circle they look at its middle, but for what a chord beyond its ends is off by."""
    poses = circle_poses(12)
    viewmats, nearest = cameras_beside(poses, 360, seeded())
    assert viewmats.dtype == torch.float64
    torch.testing.assert_close(torch.linalg.det(viewmats[:, :3, :3]), torch.ones(360, dtype=torch.float64))
    towards = torch.nn.functional.normalize(-camera_centers(viewmats), dim=1)
    assert float((towards * viewmats[:, 2, :3]).sum(dim=1).min()) > 0.8
    assert int(torch.bincount(nearest, minlength=12).min()) > 10


def test_between_cameras_back_to_back_there_is_nothing() -> None:
    """Nor beside a single one, or where none is asked for."""
    outwards = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], dtype=torch.float64)
    apart = look_at(0.01 * outwards, outwards, UP)
    for poses, count in ((apart, 5), (row(1), 5), (row(2), 0)):
        viewmats, nearest = cameras_beside(poses, count, seeded())
        assert viewmats.shape == (0, 4, 4)
        assert len(nearest) == 0


@pytest.mark.parametrize("count", [1, 7, 100])
def test_they_are_as_many_as_asked_for_and_the_same_for_a_seed(count: int) -> None:
    first, again, other = (cameras_beside(circle_poses(9), count, seeded(seed))[0] for seed in (1, 1, 2))
    assert len(first) == count
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
