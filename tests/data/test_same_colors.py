"""Colours that are one colour from all sides, and those of what lies behind a lid."""

import math

import pytest
import torch

from etsplat.data.agreement import looked_at
from etsplat.data.photograph import photograph
from etsplat.data.same_colors import sameness, surface_sameness
from etsplat.geometry.icosphere import icosphere
from etsplat.io.mesh_files import MeshFile

VIEWS, PLACES = 12, 4000


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.1, 0.2])
def test_it_is_what_variance_within_places_leaves_of_all(noise: float) -> None:
    """Of places whose colours have a standard deviation of 0.1, with noise of its own in each photo."""
    generator = torch.Generator().manual_seed(0)
    own = 0.5 + 0.1 * torch.randn(1, PLACES, 3, generator=generator)
    colors = own + noise * torch.randn(VIEWS, PLACES, 3, generator=generator)
    seen = torch.rand(VIEWS, PLACES, generator=generator) < 0.5
    colors = torch.where(seen[..., None], colors, math.pi)  # what is not seen does not count
    assert sameness(colors, seen) == pytest.approx(0.01 / (0.01 + noise**2), abs=0.02)


def test_what_is_plain_or_seen_by_one_says_nothing() -> None:
    generator = torch.Generator().manual_seed(0)
    seen = torch.ones(VIEWS, PLACES, dtype=torch.bool)
    assert sameness(torch.full((VIEWS, PLACES, 3), 0.5), seen) == 0
    alone = torch.nn.functional.one_hot(torch.arange(PLACES) % VIEWS, VIEWS).T.bool()
    assert sameness(torch.rand(VIEWS, PLACES, 3, generator=generator), alone) == 0


def test_a_surface_is_told_from_one_that_is_not_there() -> None:
    """White, of a ball that is shaded, and of one beside it."""
    vertices, faces = icosphere(4)
    views = photograph(MeshFile(vertices, faces), 160, 160)
    right, wrong = (looked_at(views, scale * vertices, faces) for scale in (1.0, 0.6))
    assert right is not None
    assert wrong is not None
    assert surface_sameness(right) > 0.95
    assert surface_sameness(wrong) < 0.6
