"""What holds tensors prints in a line."""

from collections.abc import Callable
from typing import Any

import pytest
import torch

import etsplat

CAMERAS = etsplat.orbit_cameras(16, 12, azimuths=1)
MESH = etsplat.TriangleMesh.from_mesh(*etsplat.icosphere(2), colors=0.5, opacity=0.9, sigma=0.3)


def test_shapes_stand_for_tensors() -> None:
    """With what is unusual of them."""
    assert repr(CAMERAS) == "Cameras(viewmats=<5x4x4>, Ks=<5x3x3>, width=16, height=12)"
    assert "viewmats=<5x4x4 float64>" in repr(CAMERAS.to(dtype=torch.float64))
    assert "log_sigma=<scalar>" in repr(MESH)


@pytest.mark.parametrize(
    "make",
    [
        lambda: MESH,
        lambda: MESH.render(CAMERAS),
        lambda: etsplat.photograph(etsplat.demo_object(), 8, 8),
        etsplat.demo_object,
    ],
)
def test_nothing_prints_its_numbers(make: Callable[[], Any]) -> None:
    shown = repr(make())
    assert "tensor([[" not in shown
    assert len(shown) < 1000
