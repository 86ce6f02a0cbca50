"""Points before all others: those that photos see in different colours go, others stay."""

from dataclasses import replace

import pytest
import torch

from etsplat.data.dataset import Dataset
from etsplat.data.demo_scene import demo_scene
from etsplat.data.pictures import StoredPictures
from etsplat.data.stray_points import without_strays

STRAYS = 7


@pytest.fixture(scope="module")
def scene() -> Dataset:
    """With points a tenth of the way from cameras to what they look at, first in the list."""
    scene = demo_scene(96, 72)
    assert scene.exact_points is not None
    assert scene.point_colors is not None
    forward = scene.viewmats[scene.train[:STRAYS], 2, :3]
    strays = scene.centers[scene.train[:STRAYS]] + 0.1 * scene.centers.norm(dim=1).mean() * forward
    points, colors = torch.cat([strays, scene.exact_points]), torch.cat([torch.rand(STRAYS, 3), scene.point_colors])
    return replace(scene, exact_points=points, point_colors=colors)


@pytest.mark.parametrize("colored", [True, False])
def test_strays_go_and_a_note_says_so(scene: Dataset, colored: bool) -> None:
    """Whether or not points have colours of their own."""
    capture = scene if colored else replace(scene, point_colors=None)
    left = without_strays(capture, 0.75)
    assert scene.exact_points is not None
    assert left.exact_points is not None
    assert torch.equal(left.exact_points, scene.exact_points[STRAYS:])
    assert (left.point_colors is None) != colored
    assert f"{STRAYS} points hang before all others" in left.notes[-1]


def test_points_in_one_colour_stay_however_near(scene: Dataset) -> None:
    """Photos that all show one grey agree on everything."""
    assert scene.point_colors is not None
    grey = [torch.full_like(image, 128) for image in scene.images]
    capture = replace(scene, images=StoredPictures(grey), point_colors=torch.full_like(scene.point_colors, 0.5))
    assert without_strays(capture, 0.75) is capture


def test_nothing_goes_where_nothing_is_asked_or_known(scene: Dataset) -> None:
    """Without points, and with 0."""
    assert without_strays(scene, 0.0) is scene
    bare = replace(scene, exact_points=None, point_colors=None)
    assert without_strays(bare, 0.75) is bare


def test_test_photos_are_not_asked(scene: Dataset) -> None:
    """They may show anything."""
    black = [torch.zeros_like(image) if view in scene.test else image for view, image in enumerate(scene.images)]
    first, second = without_strays(scene, 0.75), without_strays(replace(scene, images=StoredPictures(black)), 0.75)
    assert first.exact_points is not None
    assert second.exact_points is not None
    assert torch.equal(first.exact_points, second.exact_points)
