"""Cameras that are written as matrices."""

from pathlib import Path

import pytest
import torch

from etsplat.core.errors import InputError
from etsplat.data.matrix_cameras import checked_intrinsics, decomposed
from etsplat.data.scene_files import Entry
from helpers.captures import circle_poses

ENTRY = Entry(Path("cameras.npz"), "camera 0", {})
K = torch.tensor([[900.0, 0, 310], [0, 870, 255], [0, 0, 1]], dtype=torch.float64)


@pytest.mark.parametrize("factor", [1.0, -1.0, 1e-6, -3e5])
def test_a_projection_is_taken_apart_into_the_camera_that_made_it(factor):
    """Up to any factor: of both signs the camera is the one with its axes' handedness."""
    for viewmat in circle_poses(5, (4.0, -2.0, 1.0)):
        found, pose = decomposed(ENTRY, factor * (K @ viewmat[:3]))
        torch.testing.assert_close(found, K, rtol=1e-10, atol=1e-8)
        torch.testing.assert_close(pose, viewmat, rtol=1e-10, atol=1e-10)


def test_intrinsics_with_skew_or_in_another_order_are_refused():
    torch.testing.assert_close(checked_intrinsics(ENTRY, 2 * K), K)
    skewed = K.clone()
    skewed[0, 1] = 1.0
    with pytest.raises(InputError, match="camera 0 has skew"):
        checked_intrinsics(ENTRY, skewed)
    for odd in (K.T, K * torch.tensor([-1.0, 1, 1]), K * float("nan"), torch.zeros(3, 3, dtype=torch.float64)):
        with pytest.raises(InputError, match="has intrinsics that are no camera's"):
            checked_intrinsics(ENTRY, odd)


def test_a_projection_onto_a_line_is_refused():
    flat = K @ circle_poses(1)[0][:3]
    flat[2] = flat[1]
    with pytest.raises(InputError, match="projects onto no image"):
        decomposed(ENTRY, flat)
