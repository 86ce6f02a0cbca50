"""Small groups of triangles away from everything else."""

import torch

from etsplat.geometry.isolation import standing_alone


def plane(side: int = 6) -> torch.Tensor:
    """A square of 2 side^2 triangles in z = 0, each cell 1 x 1."""
    cells = torch.cartesian_prod(torch.arange(side), torch.arange(side)).float()
    flat = torch.cat([torch.tensor([[0.0, 0], [1, 0], [0, 1]]), torch.tensor([[1.0, 0], [1, 1], [0, 1]])]).reshape(
        2, 3, 2
    )
    corners = cells[:, None, None] + flat[None]
    return torch.nn.functional.pad(corners.reshape(-1, 3, 2), (0, 1))


def shard(x: float, y: float, z: float, size: float = 0.5) -> torch.Tensor:
    return torch.tensor([[x, y, z]]) + size * torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])


def test_a_shard_is_alone_where_it_is_farther_away_than_it_is_large() -> None:
    """Its farthest corner is 0.37 from the mean of its corners: at 0.3 above the plane it belongs to it."""
    near, far = shard(3, 3, 0.3), shard(3, 3, 0.6)
    alone = standing_alone(torch.cat([plane(), near]))
    assert not bool(alone.any())
    alone = standing_alone(torch.cat([plane(), far]))
    assert alone.tolist() == [False] * 72 + [True]


def test_distance_is_that_from_the_surface_not_from_corners() -> None:
    """A small shard just above the middle of one large triangle, whose corners are far away."""
    large = 50 * plane(4)
    above = shard(10, 10, 0.05, 0.1)
    assert not bool(standing_alone(torch.cat([large, above])).any())
    assert bool(standing_alone(torch.cat([large, above + torch.tensor([0.0, 0, 5])]))[-1])


def test_a_group_counts_as_a_whole() -> None:
    """Eight triangles beside each other are larger than one, and so are not alone at a distance where one would be."""
    patch = plane(2) + torch.tensor([0.0, 0, 1.2])
    assert not bool(standing_alone(torch.cat([plane(), patch])).any())
    assert int(standing_alone(torch.cat([plane(), patch[:1]])).sum()) == 1
    away = patch + torch.tensor([0.0, 0, 5])
    assert int(standing_alone(torch.cat([plane(), away])).sum()) == 8
    assert not bool(standing_alone(torch.cat([plane(), away]), few=7).any())


def test_the_largest_group_stays_however_small() -> None:
    three = torch.cat([shard(0, 0, 0), shard(0.1, 0, 0), shard(50, 0, 0)])
    assert standing_alone(three).tolist() == [False, False, True]
    assert standing_alone(three[:1]).tolist() == [False]
    assert standing_alone(three[:0]).tolist() == []
    assert not bool(standing_alone(three[1:]).any())  # neither is the larger one


def test_in_a_cloud_of_shards_none_is_alone() -> None:
    """Though all of them are far from the few that happen to be beside each other."""
    cloud = torch.cat([shard(10.0 * x, 10.0 * y, 0) for x in range(20) for y in range(20)])
    assert not bool(standing_alone(torch.cat([cloud, shard(0.1, 0, 0)])).any())
    assert int(standing_alone(torch.cat([cloud[:70], plane() - 50])).sum()) == 70


def test_it_does_not_depend_on_units_or_on_the_origin() -> None:
    corners = torch.cat([plane(), shard(3, 3, 0.6), shard(3, 3, 0.3)]).double()
    expected = standing_alone(corners)
    assert torch.equal(standing_alone(1e-3 * corners), expected)
    assert torch.equal(standing_alone(1e3 * corners + 1e5), expected)
