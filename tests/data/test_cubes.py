"""Points thinned to the means of cubes of one size, or of cubes that look alike."""

from dataclasses import replace

import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.data.cubes import seen_sizes, thinned
from etsplat.data.demo_scene import demo_scene


@pytest.fixture(scope="module")
def points() -> Float[Tensor, "P 3"]:
    """In a box that is ten times as long as wide."""
    generator = torch.Generator().manual_seed(0)
    return torch.rand((20_000, 3), generator=generator, dtype=torch.float64) * torch.tensor([10.0, 1.0, 1.0])


def test_as_many_as_asked_for_or_hardly_fewer(points: Float[Tensor, "P 3"]) -> None:
    """Each the mean of the points of its cube, with the mean of their colours."""
    few, colors = thinned(points, points.float(), 1000)
    assert colors is not None
    assert 900 < len(few) <= 1000
    assert torch.allclose(few, colors.double(), atol=1e-4)
    assert few.min() >= points.min()
    assert (few <= points.amax(dim=0)).all()


def test_few_enough_stay_as_they_are(points: Float[Tensor, "P 3"]) -> None:
    """To the bit, and without colours."""
    same, colors = thinned(points, None, len(points))
    assert same is points
    assert colors is None


def test_larger_cubes_hold_more(points: Float[Tensor, "P 3"]) -> None:
    """Twice the side is two steps: an eighth of the points stays."""
    far = points[:, 0] > 5
    few, _ = thinned(points, None, 1000, torch.where(far, 5, 3))
    share = int((few[:, 0] > 5).sum()) / int((few[:, 0] < 5).sum())
    assert share == pytest.approx(1 / 8, abs=0.05)


def test_cubes_that_hold_others_are_left_out(points: Float[Tensor, "P 3"]) -> None:
    """Others fill half of the box: what is added is in the other, as many as before."""
    sizes = torch.zeros(len(points), dtype=torch.long)
    left = points[:, 0] < 5
    few, _ = thinned(points, None, 1000, sizes, (points[left], sizes[left]))
    assert 900 < len(few) <= 1000
    assert int((few[:, 0] < 5).sum()) == 0
    none, _ = thinned(points, None, 10, sizes, (points, sizes))
    assert len(none) == 0


def test_bits_of_one_size_do_not_depend_on_which(points: Float[Tensor, "P 3"]) -> None:
    """Sizes are relative, and so are units: half of all is half as large."""
    few, _ = thinned(points, None, 500)
    same, _ = thinned(points, None, 500, torch.full((len(points),), -7))
    half, _ = thinned(points / 2, None, 500)
    assert torch.equal(few, same)
    assert torch.equal(few / 2, half)


def test_cubes_look_alike_from_the_nearest_training_camera() -> None:
    """Twice as far off is two steps more; test cameras do not count."""
    scene = demo_scene(32, 24)
    capture = replace(scene, train=scene.train[:1])
    center, axis = capture.centers[capture.train[0]], torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    sizes = seen_sizes(center + axis * torch.tensor([[1.1], [2.2], [4.4], [0.0]]), capture)
    assert (sizes[1:3] - sizes[:2]).tolist() == [2, 2]
    assert int(sizes[3]) < int(sizes[0])
