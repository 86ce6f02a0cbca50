"""Paths are made of the cameras that there are."""

import math

import pytest
import torch

from etsplat import orbit_cameras
from etsplat.data.camera_paths import PATHS


@pytest.mark.parametrize("path", PATHS.values(), ids=PATHS)
@pytest.mark.parametrize(
    ("odd", "text"),
    [
        ({"viewmats": torch.zeros(0, 4, 4)}, "viewmats must hold at least one camera"),
        ({"viewmats": torch.eye(4)}, "viewmats must have shape"),
        ({"viewmats": torch.full((2, 4, 4), math.nan)}, "viewmats must be finite"),
        ({"viewmats": torch.ones(2, 4, 4).bool()}, "viewmats must be of floating-point numbers"),
        ({"up": torch.ones(2)}, "up must have shape"),
        ({"up": (0, 1, 0)}, "up must be a tensor"),
        ({"frames": 0}, "frames must be an integer from 1 to 1000000, got 0"),
        ({"frames": 2**40}, "frames must be an integer from 1"),
        ({"frames": None}, "frames must be an integer from 1"),
    ],
)
def test_arguments_that_make_no_path_are_refused_by_name(path, odd, text):
    views = orbit_cameras(9, 8, azimuths=2).viewmats
    with pytest.raises(ValueError, match=text):
        path(**{"viewmats": views, "up": torch.tensor([0.0, 1.0, 0.0]), "frames": 5, **odd})
