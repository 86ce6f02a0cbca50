"""Photos that a function of the caller's makes."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

import etsplat
from etsplat import LazyPictures, Picture

PHOTOS = etsplat.photograph(etsplat.demo_object(), 16, 12, elevations=(0.0,), azimuths=5, supersampling=1)
SIZES = [(16, 12)] * len(PHOTOS)


def fitted(images: Any, run: Path | None = None) -> torch.Tensor:
    mesh = etsplat.TriangleMesh.from_mesh(*etsplat.icosphere(1), colors=0.7, opacity=0.98, sigma=0.25)
    trainer = etsplat.Trainer(mesh, replace(PHOTOS, images=images), etsplat.Objective(etsplat.Photometric()))
    trainer.fit(4, run=run)
    return trainer.model.vertices


def test_a_function_that_makes_photos_is_all_that_a_run_needs(tmp_path: Path) -> None:
    """Pixels alone will do; with the bits of photos in memory, kept and gone on with."""
    asked: list[int] = []

    def make(view: int) -> torch.Tensor:
        asked.append(view)
        return PHOTOS.images[view]

    lazy = LazyPictures(make, SIZES)
    assert asked == []
    assert fitted(lazy).equal(fitted(PHOTOS.images))
    assert fitted(lazy, tmp_path / "run").equal(fitted(LazyPictures(make, SIZES), tmp_path / "run"))
    other = LazyPictures(lambda view: 0.5 * PHOTOS.images[view], SIZES)
    with pytest.raises(etsplat.InputError, match="checkpoint"):
        fitted(other, tmp_path / "run")


def test_masks_are_taken_as_photos_in_memory_have_them() -> None:
    inside = torch.rand(12, 16, generator=torch.Generator().manual_seed(0)) < 0.5
    lazy = LazyPictures(lambda view: Picture(PHOTOS.images[view], inside), SIZES)  # pyright: ignore[reportArgumentType]
    assert torch.equal(lazy.picture(2).mask, inside.byte() * 255)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("made", "message"),
    [
        (torch.zeros(16, 12, 3), r"make\(0\) must have 16 x 12 pixels, as `sizes` says, got shape \(16, 12, 3\)"),
        (torch.zeros(12, 16), r"make\(0\) must have shape \(H, W, 3\) or \(H, W, 4\)"),
        (torch.zeros(12, 16, 3).numpy(), r"make\(0\) must be a tensor .*: pass torch\.from_numpy"),
        (None, r"make\(0\) must be a tensor of shape .* got NoneType"),
        (torch.full((12, 16, 3), 255.0), r"make\(0\) must be in \[0, 1\], got 255 to 255"),
        (Picture(torch.zeros(12, 16, 3), torch.zeros(3, 3)), r"the mask of make\(0\) must have shape \(12, 16\)"),
    ],
)
def test_what_is_no_such_photo_is_named(made: Any, message: str) -> None:
    """Runs ended somewhere in the middle of a step."""
    with pytest.raises(ValueError, match=message):
        LazyPictures(lambda view: made, SIZES)[0]


def test_sizes_are_those_of_images() -> None:
    with pytest.raises(ValueError, match="width must be an integer from 1"):
        LazyPictures(lambda view: torch.zeros(1, 1, 3), [(0, 3)])
    with pytest.raises(ValueError, match=r"sizes_in_bytes: expected [0-9]+, one for each photo, got 1"):
        LazyPictures(lambda view: torch.zeros(1, 1, 3), SIZES, [9])
