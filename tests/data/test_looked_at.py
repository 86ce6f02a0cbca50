"""What is in the frames of a capture, and what they have in their middle."""

from dataclasses import replace

import pytest
import torch

from etsplat.core.cameras import intrinsics, look_at
from etsplat.data.dataset import Dataset
from etsplat.data.looked_at import frames_around, looked_at, out_of_every_frame
from etsplat.data.pictures import StoredPictures


@pytest.fixture
def capture() -> Dataset:
    """Eight cameras at 3 from the origin, in the plane y = 0; one more, for testing, far above. 90 degrees upright."""
    angles = torch.arange(8) * (torch.pi / 4)
    eyes = 3 * torch.stack([angles.cos(), torch.zeros(8), angles.sin()], dim=1)
    eyes = torch.cat([eyes, torch.tensor([[0.1, 90.0, 0]])])
    viewmats = look_at(eyes, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    images = StoredPictures([torch.zeros(20, 20, 3, dtype=torch.uint8)] * 9)
    Ks = intrinsics(90.0, 20, 20).repeat(9, 1, 1)
    return Dataset(viewmats.double(), Ks.double(), images, list("abcdefghi"), list(range(8)), [8])


def test_frames_around_a_point_are_counted(capture: Dataset) -> None:
    """The origin is in all; what is above the cameras in none, though the test view shows it."""
    points = torch.tensor([[0.0, 0, 0], [0, 80, 0], [3.5, 0, 0], [2.9, 0, 0]])
    assert frames_around(capture, points).tolist() == [8, 0, 3, 6]


def test_a_triangle_is_out_of_a_frame_if_it_is_wholly_beyond_one_side(capture: Dataset) -> None:
    """One that reaches through the picture with its corners outside is not."""
    inside = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]])
    across = torch.tensor([[0.0, -50, 0], [0.1, 50, 0], [-0.1, 50, 0]])
    above = inside + torch.tensor([0.0, 50, 0])
    vertices = torch.stack([inside, across, above])
    assert out_of_every_frame(capture, vertices, 0.01).tolist() == [False, False, True]
    assert out_of_every_frame(capture, vertices, 2.0).tolist() == [False, False, True]
    assert bool(out_of_every_frame(capture, vertices, 3.2).all())


def test_photos_that_go_around_something_look_at_it(capture: Dataset) -> None:
    """Not at the walls, each of which is in the frames of a few; single stray points change little."""
    generator = torch.Generator().manual_seed(0)
    thing = torch.tensor([0.2, -0.1, 0.1]) + 0.3 * torch.nn.functional.normalize(
        torch.randn(400, 3, generator=generator)
    )
    walls = 10 * torch.nn.functional.normalize(torch.randn(4000, 3, generator=generator))
    found = looked_at(capture, torch.cat([thing, walls, torch.tensor([[0.0, 2.5, 0.0]])]))
    assert torch.tensor(found.middle).allclose(torch.tensor([0.2, -0.1, 0.1]), atol=0.05)
    assert found.radius == pytest.approx(1.1 * 0.3, rel=0.1)
    assert bool(found.holds(thing).all())


def test_photos_that_all_look_the_same_way_look_at_everything(capture: Dataset) -> None:
    eyes = torch.tensor([[x, 0.0, 10.0] for x in (-1.0, -0.5, 0.0, 0.5, 1.0)])
    viewmats = look_at(eyes, eyes * torch.tensor([1.0, 1, 0]), torch.tensor([0.0, 1.0, 0.0]))
    images = StoredPictures([torch.zeros(20, 20, 3, dtype=torch.uint8)] * 5)
    parallel = Dataset(viewmats.double(), capture.Ks[:5], images, list("abcde"), list(range(5)), [])
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(1)) - 0.5
    assert float(looked_at(parallel, 6 * points).holds(6 * points).float().mean()) > 0.95


def test_where_nothing_is_in_any_frame_it_is_what_there_is(capture: Dataset) -> None:
    points = torch.tensor([[0.0, 50, 0], [1, 50, 0]])
    assert bool(looked_at(replace(capture, train=[0]), points).holds(points).all())
