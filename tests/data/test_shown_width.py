from dataclasses import replace

import pytest
import torch

from etsplat.core.cameras import intrinsics, look_at
from etsplat.data.dataset import Dataset
from etsplat.data.pictures import StoredPictures
from etsplat.data.shown_width import ShownWidths, shown_width


def capture(width: int, height: int, distance: float, fov: float = 60.0) -> Dataset:
    """Four cameras around the origin."""
    eyes = distance * torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 0, 1], [0, 0, -1]])
    viewmats = look_at(eyes, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    Ks = intrinsics(fov, width, height).repeat(4, 1, 1)
    images = StoredPictures([torch.zeros(height, width, 3, dtype=torch.uint8)] * 4)
    return Dataset(viewmats.double(), Ks.double(), images, list("abcd"), [0, 1, 2], [3])


def test_it_is_what_a_photo_shows_across_and_so_the_same_at_any_size() -> None:
    """60 degrees upright at distance 3: 2 * 3 * tan 30 high, and twice as wide."""
    points = 1e-3 * torch.randn(500, 3, generator=torch.Generator().manual_seed(0))
    expected = 2 * 3 * 3**-0.5 * 2
    assert shown_width(capture(80, 40, 3.0), points) == pytest.approx(expected, rel=1e-3)
    assert shown_width(capture(160, 80, 3.0), points) == pytest.approx(expected, rel=1e-3)
    assert shown_width(capture(80, 40, 300.0), points) == pytest.approx(100 * expected, rel=1e-3)


def test_points_that_training_photos_do_not_show_do_not_count() -> None:
    views = capture(80, 40, 3.0)
    points = torch.tensor([[0.0, 0, 0], [0, 50, 0], [0, 0, 2.9], [0, 1e-9, 0]])
    assert shown_width(views, points) == pytest.approx(2 * 3 * 3**-0.5 * 2, rel=1e-3)
    assert shown_width(replace(views, train=[], test=[]), points) is None
    assert shown_width(views, points[1:2]) is None


def test_what_many_photos_show_counts_no_more_than_what_one_does() -> None:
    """Ten points in the middle, in all three photos, and fifteen far behind it, in one."""
    points = torch.cat([torch.zeros(10, 3), torch.tensor([[-60.0, 0.0, 0.0]]).expand(15, 3)])
    assert shown_width(capture(80, 40, 3.0), points) == pytest.approx(2 * 63 * 3**-0.5 * 2, rel=1e-3)


def test_widths_of_points_are_those_of_the_photos_that_show_them() -> None:
    """Of the origin that of every photo; elsewhere their harmonic mean; none of what none shows."""
    views = capture(80, 40, 3.0)
    widest = 2 * 3**-0.5 * 2  # at a distance of 1
    points = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [0, 50, 0], [0, 0, -4.0]])
    shown = ShownWidths(views)(points)  # trained on: from x = 3, x = -3 and z = 3
    assert shown[0] == pytest.approx(3 * widest, rel=1e-5)
    assert shown[1] == pytest.approx(3 / (1 / 2 + 1 / 4 + 1 / 3) * widest, rel=1e-5)
    assert not shown[2].isfinite()
    assert shown[3] == pytest.approx(7 * widest, rel=1e-5)


def test_widths_grow_with_the_frame_and_not_with_the_photos() -> None:
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    once = ShownWidths(capture(80, 40, 3.0))(points)
    torch.testing.assert_close(ShownWidths(capture(160, 80, 3.0))(points), once, equal_nan=True)
    torch.testing.assert_close(ShownWidths(capture(80, 40, 300.0))(100 * points), 100 * once, equal_nan=True)
