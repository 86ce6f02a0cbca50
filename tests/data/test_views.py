import pytest
import torch

from etsplat.core.cameras import Cameras, intrinsics, look_at
from etsplat.data.views import Normalization, PosedViews, every_eighth


@pytest.fixture
def views(rng):
    eyes = 4 * torch.nn.functional.normalize(torch.randn(5, 3, generator=rng), dim=1)
    cameras = Cameras(
        look_at(eyes, torch.zeros(3), torch.tensor([0.1, 1.0, 0.2])), intrinsics(50, 8, 6).repeat(5, 1, 1), 8, 6
    )
    return PosedViews(cameras, torch.zeros(5, 6, 8, 4), list("abcde"), [0, 1, 3, 4], [2], Normalization.identity())


def test_renormalised_cameras_see_moved_points_at_the_same_pixels(views, rng):
    center, radius = torch.tensor([0.3, -0.2, 0.5]), 1.7
    moved = views.renormalized(center, radius)
    points = torch.randn(20, 3, generator=rng) * 0.5

    def pixels(cameras, points):
        p = points @ cameras.viewmats[:, :3, :3].mT + cameras.viewmats[:, None, :3, 3]
        q = p @ cameras.Ks.mT
        return q[..., :2] / q[..., 2:]

    torch.testing.assert_close(
        pixels(moved.cameras, moved.normalization.apply(points)), pixels(views.cameras, points), atol=1e-4, rtol=1e-4
    )


def test_renormalising_twice_composes(views, rng):
    twice = views.renormalized(torch.tensor([0.3, 0.1, 0]), 2.0).renormalized(torch.tensor([-0.1, 0, 0.4]), 0.5)
    points = torch.randn(7, 3, generator=rng)
    step = Normalization(torch.tensor([0.3, 0.1, 0]), 2.0).apply(points)
    expected = Normalization(torch.tensor([-0.1, 0, 0.4]), 0.5).apply(step)
    torch.testing.assert_close(twice.normalization.apply(points), expected)
    torch.testing.assert_close(twice.normalization.invert(expected), points)


def test_contradicting_fields_are_refused(views):
    with pytest.raises(ValueError, match="images: expected shape"):
        PosedViews(views.cameras, torch.zeros(5, 8, 6, 4), views.names, [0], [1], views.normalization)
    with pytest.raises(ValueError, match="names"):
        PosedViews(views.cameras, views.images, ["a"], [0], [1], views.normalization)
    with pytest.raises(ValueError, match="disjoint"):
        PosedViews(views.cameras, views.images, views.names, [0, 1], [1], views.normalization)
    with pytest.raises(ValueError, match=r"in \[0, 5\)"):
        PosedViews(views.cameras, views.images, views.names, [0, 5], [1], views.normalization)


def test_every_eighth_holds_out_the_first_and_every_eighth_after_it():
    train, test = every_eighth([f"{k:02d}" for k in range(18)])
    assert test == [0, 8, 16]
    assert sorted(train + test) == list(range(18))
