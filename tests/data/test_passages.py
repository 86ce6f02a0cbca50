"""How far a hollow goes on through narrow passages."""

import torch
from torch import Tensor

from etsplat.data.passages import through_wide_passages

WALL = 0.1


def cylinder(points: Tensor, radius: float, low: float, high: float) -> Tensor:
    """Distance from one about the z axis, negative inside."""
    around = points[:, :2].norm(dim=1) - radius
    along = (points[:, 2] - (low + high) / 2).abs() - (high - low) / 2
    both = torch.stack([around, along])
    return both.clamp_min(0).norm(dim=0) + both.amax(dim=0).clamp_max(0)


def goblet(points: Tensor) -> Tensor:
    """A cup on a stem and a foot, all solid."""
    parts = [cylinder(points, *each) for each in ((0.5, 0.0, 0.8), (0.15, -0.5, 0.1), (0.5, -0.9, -0.5))]
    return torch.stack(parts).amin(dim=0)


def beyond(points: Tensor) -> Tensor:
    """How far points are farther than walls are thick from all but the cup's lid."""
    no_lid = torch.stack([cylinder(points, 0.5, 0.0, 9.0), goblet(points)]).amin(dim=0)
    return -no_lid - WALL


LID = torch.cartesian_prod(*2 * [torch.arange(-0.35, 0.36, 0.05)], torch.tensor([0.8]))
BOX = torch.tensor([[-0.5, -0.5, -0.9], [0.5, 0.5, 0.8]])


def test_the_foot_of_a_cup_is_no_part_of_its_hollow() -> None:
    """Though it is thicker than walls, and a tube through the stem is free, too."""
    free = through_wide_passages(beyond, goblet, LID, BOX, WALL)
    cup = torch.tensor([[0.0, 0.0, 0.5], [0.0, 0.0, 0.11], [0.27, 0.27, 0.12], [0.39, 0.0, 0.79]])
    foot = torch.tensor([[0.0, 0.0, -0.7], [0.3, 0.0, -0.7], [0.0, 0.0, -0.3]])
    assert float(beyond(torch.cat([cup, foot])).min()) > 0
    torch.testing.assert_close(free(cup), beyond(cup))
    assert float(free(foot).max()) < 0


def test_a_hollow_under_an_opening_that_is_narrow_all_over_is_taken_as_a_whole() -> None:
    free = through_wide_passages(beyond, goblet, LID[:1] + 9, BOX, WALL)
    places = torch.tensor([[0.0, 0.0, 0.5], [0.0, 0.0, -0.7]])
    assert torch.equal(free(places), beyond(places))
    nothing = through_wide_passages(lambda points: points[:, 0] * 0 - 1, goblet, LID, BOX, WALL)
    assert float(nothing(places).max()) == -1
