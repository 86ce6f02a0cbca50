"""Posed photos: which fields fit together, other frames, other sizes."""

from dataclasses import replace

import pytest
import torch

from etsplat.core.cameras import intrinsics, look_at
from etsplat.data.dataset import Dataset, Normalization, every_eighth
from etsplat.data.pictures import StoredPictures


@pytest.fixture
def views(rng) -> Dataset:
    eyes = 4 * torch.nn.functional.normalize(torch.randn(5, 3, generator=rng, dtype=torch.float64), dim=1)
    viewmats = look_at(eyes, torch.zeros(3), torch.tensor([0.1, 1.0, 0.2]))
    Ks = intrinsics(50, 8, 6, torch.float64).repeat(5, 1, 1)
    photos = torch.rand(5, 6, 8, 4, generator=rng)
    return Dataset(viewmats, Ks, StoredPictures(photos), list("abcde"), [0, 1, 3, 4], [2])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_renormalised_cameras_see_moved_points_at_the_same_pixels(views, rng, dtype):
    center, radius = torch.tensor([0.3, -0.2, 0.5], dtype=dtype), 1.7
    points = torch.randn(20, 3, generator=rng, dtype=torch.float64) * 0.5
    moved = replace(views, exact_points=points).renormalized(center, radius)

    def pixels(dataset, points):
        p = points @ dataset.viewmats[:, :3, :3].mT + dataset.viewmats[:, None, :3, 3]
        q = p @ dataset.Ks.mT
        return q[..., :2] / q[..., 2:]

    tolerance = 1e-4 if dtype == torch.float32 else 1e-10
    for there in (moved.normalization.apply(points), moved.exact_points):
        torch.testing.assert_close(pixels(moved, there), pixels(views, points), atol=tolerance, rtol=tolerance)


def test_renormalising_twice_composes(views, rng):
    twice = views.renormalized(torch.tensor([0.3, 0.1, 0]), 2.0).renormalized(torch.tensor([-0.1, 0, 0.4]), 0.5)
    points = torch.randn(7, 3, generator=rng)
    step = Normalization(torch.tensor([0.3, 0.1, 0]), 2.0).apply(points)
    expected = Normalization(torch.tensor([-0.1, 0, 0.4]), 0.5).apply(step)
    torch.testing.assert_close(twice.normalization.apply(points), expected)
    torch.testing.assert_close(twice.normalization.invert(expected), points)


def test_what_was_moved_comes_back_to_the_units_of_the_input(views):
    moved = views.renormalized(torch.tensor([5.0, -1.0, 3.0], dtype=torch.float64), 4.0)
    back, start = moved.in_input_units(), views.in_input_units()
    torch.testing.assert_close(back.viewmats, start.viewmats, rtol=0, atol=1e-6)
    assert back.normalization.radius == 1
    assert not back.normalization.center.any()


def test_contradicting_fields_are_refused(views):
    with pytest.raises(ValueError, match="images: expected 5, one per viewmat, got 4"):
        replace(views, images=StoredPictures(list(views.images)[:4]))
    with pytest.raises(ValueError, match="names"):
        replace(views, names=["a"])
    with pytest.raises(ValueError, match="disjoint"):
        replace(views, train=[0, 1], test=[1])
    with pytest.raises(ValueError, match=r"in \[0, 5\)"):
        replace(views, test=[5])


def test_every_eighth_holds_out_the_first_and_every_eighth_after_it():
    train, test = every_eighth(18)
    assert test == [0, 8, 16]
    assert sorted(train + test) == list(range(18))


@pytest.mark.parametrize("kind", ["float", "bytes"])
def test_halved_views_are_means_of_pixels_and_masks_whatever_their_sizes(views, rng, kind):
    """Odd sizes are rounded down; a pixel keeps its place in the picture."""
    sizes = [(8, 6), (7, 5), (1, 4), (6, 6), (2, 2)]
    photos = [torch.rand(height, width, 4, generator=rng) for width, height in sizes]
    if kind == "bytes":
        photos = [(255 * photo).to(torch.uint8)[..., :3] for photo in photos]
    masks = [None, None, None, torch.tensor([0, 255], dtype=torch.uint8).repeat(6, 3), None]
    half = replace(views, images=StoredPictures(photos, masks)).halved()
    assert half.images.sizes == [(4, 3), (3, 2), (1, 2), (3, 3), (1, 1)]
    assert half.images[0].dtype == photos[0].dtype
    mean = photos[0][2:4, 4:6].float().mean(dim=(0, 1))
    torch.testing.assert_close(half.images[0][1, 2].float(), mean, atol=0.5 if kind == "bytes" else 1e-6, rtol=0)
    assert half.images.mask(3).tolist() == [[128] * 3] * 3
    assert half.images.mask(0) is None
    torch.testing.assert_close(half.Ks[1, 0], views.Ks[1, 0] * 3 / 7, atol=1e-6, rtol=1e-6)
    assert torch.equal(half.viewmats, views.viewmats)


def test_masks_are_there_where_a_pixel_is_transparent(views):
    def of(photos):
        return replace(views, images=StoredPictures(photos)).has_masks

    opaque = torch.ones(5, 6, 8, 4)
    hole = opaque.clone()
    hole[3, 0, 0, 3] = 0.99
    assert views.has_masks
    assert [of(hole), of(opaque), of(opaque[..., :3])] == [True, False, False]
    opaque_bytes = torch.full((5, 6, 8, 4), 255, dtype=torch.uint8)
    hole_bytes = (255 * hole).to(torch.uint8)
    assert [of(opaque_bytes), of(opaque_bytes[..., :3]), of(hole_bytes)] == [False, False, True]
