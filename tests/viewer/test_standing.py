"""Browsers stand at photos, and near them."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from etsplat.data.dataset import Dataset
from etsplat.data.load import load_dataset
from etsplat.data.looked_at import middle_photo
from etsplat.viewer.standing import Neighbourhood, nearest_photo, stand_at
from helpers.captures import circle_poses, write_colmap


@pytest.fixture
def capture(tmp_path: Path) -> Dataset:
    write_colmap(tmp_path / "scene", [(32, 24)] * 9)
    return load_dataset(tmp_path / "scene", preload=False)


def test_what_is_near_a_photo_stays_and_what_is_far_comes_back(capture: Dataset) -> None:
    """A quarter as far from it as that is from what it shows, or on the way to the next one; turned no way."""
    near = Neighbourhood.of(capture)
    away = 3 * math.sqrt(1.09)
    assert near.margin == pytest.approx(max(0.25 * away, 0.6 * 2 * 3 * math.sin(math.pi / 9)), rel=0.1)
    photo = capture.centers[capture.train[0]]
    for factor, stays in ((0.9, True), (1.5, False), (100.0, False)):
        place = photo + torch.tensor([0.0, factor * near.margin, 0.0], dtype=torch.float64)
        assert torch.equal(near.nearest(place), place) is stays
        assert float((near.nearest(place) - photo).norm()) <= near.margin + 1e-9
    camera = capture.cameras[capture.train[0]]
    assert near.kept(camera) is camera
    moved = camera.viewmats.clone()
    moved[0, 2, 3] += 50
    kept = near.kept(replace(camera, viewmats=moved))
    torch.testing.assert_close(kept.viewmats[0, :3, :3], camera.viewmats[0, :3, :3])
    assert float(near.nearest(kept.centers[0]).sub(kept.centers[0]).norm()) < 1e-5
    assert near.kept(kept) is kept  # and not moved again and again


def test_the_photo_nearest_to_a_camera_is_found(capture: Dataset) -> None:
    for index in (0, 3, 8):
        assert nearest_photo(capture, capture.cameras[index]) == index


def test_the_middle_photo_is_in_the_middle(capture: Dataset) -> None:
    """Of those that are trained on."""
    line = circle_poses(1)[0].expand(9, 4, 4).clone()
    line[:, 0, 3] += torch.tensor([0.0, 1, 2, 3, 4.1, 5, 6, 7, 8], dtype=torch.float64)
    assert middle_photo(replace(capture, viewmats=line)) == 4


def test_a_browser_at_a_photo_sees_what_the_photo_does(capture: Dataset) -> None:
    from contextlib import nullcontext

    camera = SimpleNamespace()
    stand_at(SimpleNamespace(camera=camera, atomic=nullcontext), capture, 2)
    np.testing.assert_allclose(camera.position, capture.centers[2])
    ahead = (camera.look_at - camera.position) / np.linalg.norm(camera.look_at - camera.position)
    np.testing.assert_allclose(ahead, capture.viewmats[2, 2, :3], atol=1e-9)
    np.testing.assert_allclose(camera.up_direction, [0, 1, 0], atol=1e-6)
    assert camera.fov == pytest.approx(2 * math.atan(24 / (2 * float(capture.Ks[2, 1, 1]))))
