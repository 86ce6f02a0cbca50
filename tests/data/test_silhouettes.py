"""Masks of a ring and a ball beside it, some of them spoilt."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt, gaussian_filter

from etsplat import _native
from etsplat.data.dataset import Dataset
from etsplat.data.photograph import photograph
from etsplat.data.pictures import StoredPictures
from etsplat.data.silhouettes import (
    Evidence,
    Silhouette,
    _asked,
    contradicting,
    looks_inverted,
    lowest_depths,
    silhouette,
)
from etsplat.data.visual_hull import visual_hull
from etsplat.geometry.parts import genera
from helpers.meshes import ring_and_ball

Mask = np.ndarray


@pytest.fixture(scope="module")
def views() -> Dataset:
    """In the unit ball around the origin."""
    return photograph(ring_and_ball(0.05), 160, 160, supersampling=2)


def spoilt(views: Dataset, change: Callable[[Mask], Mask], which: list[int]) -> Dataset:
    images = [image.clone() for image in views.images]
    for index in which:
        images[index][..., 3] = torch.from_numpy(change(silhouette(images[index]))).float()
    return replace(views, images=StoredPictures(images))


def without_lower_half(mask: Mask) -> Mask:
    rows = np.flatnonzero(mask.any(axis=1))
    return mask & (np.arange(len(mask)) < (rows[0] + rows[-1]) // 2)[:, None]


def elsewhere(mask: Mask) -> Mask:
    return np.roll(mask, 15, axis=1)


def with_a_blob(mask: Mask) -> Mask:
    blob = np.zeros_like(mask)
    blob[10:60, 10:60] = True
    return mask | blob


def rough(mask: Mask) -> Mask:
    """The outline wanders by two pixels or so, otherwise in every view."""
    noise = gaussian_filter(np.random.default_rng(int(mask.sum())).standard_normal(mask.shape), 4)
    distance = np.asarray(distance_transform_edt(mask)) - np.asarray(distance_transform_edt(~mask))
    return distance + 1.5 * noise / noise.std() > 0


def evidence(views: Dataset) -> Evidence:
    return Evidence.of([Silhouette(views, index) for index in views.train], torch.zeros(3), 1.0)


def test_masks_of_one_object_explain_each_other(views: Dataset) -> None:
    found = evidence(views)
    assert contradicting(views) == []
    assert not found.excluded.any()
    assert float(found.depth.min()) > -1


@pytest.mark.parametrize("change", [without_lower_half, elsewhere, with_a_blob])
def test_a_mask_of_something_else_is_named(views: Dataset, change: Callable[[Mask], Mask]) -> None:
    wrong = views.train[7]
    assert contradicting(spoilt(views, change, [wrong])) == [wrong]


def test_it_is_named_in_any_units_and_among_others(views: Dataset) -> None:
    wrong = views.train[3::9]
    far = spoilt(views, without_lower_half, wrong).renormalized(
        torch.tensor([40.0, -7.0, 3.0], dtype=torch.float64), 0.01
    )
    assert sorted(contradicting(far)) == wrong


@pytest.mark.parametrize("change", [without_lower_half, elsewhere, with_a_blob])
def test_a_test_photo_is_named_too_and_speaks_against_nobody(views: Dataset, change: Callable[[Mask], Mask]) -> None:
    assert contradicting(spoilt(views, change, [views.test[2]])) == [views.test[2]]
    wrong = [views.train[7], *views.test[2:4]]
    found = contradicting(spoilt(views, change, wrong))
    assert (found[0], sorted(found[1:])) == (wrong[0], wrong[1:])
    assert sorted(contradicting(spoilt(views, change, views.test))) == views.test


def test_a_quarter_is_named_at_most(views: Dataset) -> None:
    some = replace(views, train=views.train[:12])
    assert len(contradicting(spoilt(some, elsewhere, some.train[::3]))) == 3


def test_few_views_and_empty_masks_name_nobody(views: Dataset) -> None:
    wrong = views.train[2]
    few = replace(spoilt(views, without_lower_half, [wrong]), train=views.train[:5])
    assert contradicting(few) == []
    assert contradicting(spoilt(views, np.zeros_like, [wrong])) == []


def test_rough_masks_keep_what_is_thin(views: Dataset) -> None:
    """Each mask loses a bit of the ring, and they lose other bits: the hull keeps it, with its hole."""
    every = spoilt(views, rough, views.train)
    assert contradicting(every) == []
    vertices, faces = visual_hull(every, 6000)
    assert genera(faces, len(vertices)) == [1, 0]


def test_inverted_masks_are_noticed(views):
    """Of most photos; an object that fills some frames, and photos without masks, are not."""

    def with_alpha(change):
        images = []
        for index, image in enumerate(views.images):
            alpha = change(index, image[..., 3:])
            images.append(torch.cat([image[..., :3] * 0, alpha], dim=-1))
        return replace(views, images=StoredPictures(images))

    assert looks_inverted(with_alpha(lambda index, alpha: 1 - alpha))
    assert not looks_inverted(with_alpha(lambda index, alpha: alpha))
    assert not looks_inverted(with_alpha(lambda index, alpha: 1 - alpha if index % 3 == 0 else alpha))
    assert not looks_inverted(with_alpha(lambda index, alpha: torch.ones_like(alpha)))


def by_torch(view: Silhouette, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """(N,) pixels that points are within a silhouette, infinite where it does not judge; and (N,) their depths."""
    camera = points.double() @ view.viewmat[:3, :3].double().T + view.viewmat[:3, 3].double()
    z = camera[:, 2]
    pixel = camera @ view.K[:2].double().T / torch.where(z > 0, z, 1.0)[:, None]
    place = 2 * pixel / torch.tensor(view.distance.shape[:1:-1]) - 1
    found = torch.nn.functional.grid_sample(
        view.distance.double(), place[None, None], padding_mode="border", align_corners=False
    )
    judged = (z > 0) & (view.whole | (place.abs() < 1).all(dim=1))
    return torch.where(judged, found[0, 0, 0], torch.inf), z


@pytest.mark.parametrize(
    ("grown", "in_units", "with_own"), [(0.0, False, False), (1.5, True, False), (0.0, False, True)]
)
def test_lowest_depths_are_those_of_each_view_in_order(
    views: Dataset, grown: float, in_units: bool, with_own: bool
) -> None:
    """Against torch: points all around, some behind cameras, of views that show all and of others."""
    silhouettes = [Silhouette(views, index) for index in views.train]
    for view in silhouettes[::3]:
        view.whole = False
    generator = torch.Generator().manual_seed(0)
    points = 8 * torch.rand(3000, 3, generator=generator) - 4
    points[::2] /= 5
    own = torch.randint(len(silhouettes), (3000,), generator=generator) if with_own else None
    each = []
    for number, view in enumerate(silhouettes):
        pixels, z = by_torch(view, points)
        depth = torch.where(pixels.isfinite(), (pixels + grown) * (z / view.K[0, 0] if in_units else 1.0), torch.inf)
        each.append(torch.where(own == number, torch.inf, depth) if own is not None else depth)
    expected = torch.stack(each).sort(dim=0).values

    found, judges = lowest_depths(silhouettes, points, 3, grown=grown, in_units=in_units, own=own)
    assert torch.equal(judges, expected.isfinite().sum(dim=0).float())
    assert judges.min() < judges.max() == len(silhouettes) - with_own
    torch.testing.assert_close(found.double(), expected[:3], rtol=1e-4, atol=1e-3)


def test_costs_count_what_lies_outside_up_to_a_limit(views: Dataset) -> None:
    """Against sampling each map by torch."""
    silhouettes = [Silhouette(views, index) for index in views.train]
    points = 3 * torch.rand(2000, 3, generator=torch.Generator().manual_seed(1)) - 1.5
    most, cost = torch.linspace(1, 9, len(silhouettes)), torch.empty(2000)
    depths = torch.stack([by_torch(view, points)[0] for view in silhouettes])
    expected = (-depths).clamp_min(0).minimum(most[:, None]).sum(dim=0) - 1e-3 * depths.clamp(0, 1).sum(dim=0)
    _native.exclusion_costs(**_asked(silhouettes, points), most=most, cost=cost)
    torch.testing.assert_close(cost.double(), expected, rtol=1e-4, atol=1e-3)
