"""How many pixels photos have for a surface."""

import pytest
import torch

from etsplat.core.cameras import intrinsics, look_at
from etsplat.data.dataset import Dataset
from etsplat.data.pictures import StoredPictures
from etsplat.data.surface_pixels import surface_pixels

SQUARE = torch.tensor([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
HALVES = torch.tensor([[0, 1, 2], [0, 2, 3]])


def photos(*eyes: tuple[float, float, float], size: tuple[int, int] = (48, 32)) -> Dataset:
    """Seen from these places, which look at the origin; a unit across is so many pixels at distance 1."""
    width, height = size
    blank = [torch.zeros(height, width, 3, dtype=torch.uint8) for _ in eyes]
    poses = torch.stack([look_at(torch.tensor(eye), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])) for eye in eyes])
    return Dataset(
        viewmats=poses.double(),
        Ks=intrinsics(60.0, width, height).double().expand(len(eyes), 3, 3).clone(),
        images=StoredPictures(blank, [None for _ in blank]),
        names=[str(number) for number in range(len(eyes))],
        train=list(range(len(eyes))),
        test=[],
    )


def focal(views: Dataset) -> float:
    return float(views.Ks[0, 0, 0])


def test_a_square_has_the_pixels_of_its_picture() -> None:
    """From the front at distance 4; a photo from its back counts no less."""
    for side in (4.0, -4.0):
        views = photos((0.0, 0.0, side))
        assert surface_pixels(views, SQUARE, HALVES) == pytest.approx((focal(views) / 4) ** 2, rel=1e-4)


def test_the_photo_counts_that_shows_a_face_largest() -> None:
    """The nearest that has it in its frame, and is not beside it; only training photos are asked."""
    views = photos((0.0, 0.0, 4.0), (0.0, 0.0, 2.0), (3.0, 0.0, 0.01))
    assert surface_pixels(views, SQUARE, HALVES) == pytest.approx((focal(views) / 2) ** 2, rel=1e-4)
    views.train.remove(1)
    assert surface_pixels(views, SQUARE, HALVES) == pytest.approx((focal(views) / 4) ** 2, rel=1e-4)


def test_what_no_frame_holds_counts_nothing() -> None:
    """Beside the frame, and behind the camera."""
    views = photos((0.0, 0.0, 4.0))
    assert surface_pixels(views, SQUARE + torch.tensor([9.0, 0.0, 0.0]), HALVES) == 0
    assert surface_pixels(views, SQUARE + torch.tensor([0.0, 0.0, 6.0]), HALVES) == 0
    assert surface_pixels(views, SQUARE, HALVES[:0]) == 0
