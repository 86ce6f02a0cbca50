"""Photos that a function of the caller's makes."""

import copy
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

import etsplat
from etsplat import LazyPictures, Picture
from helpers.captures import write_colmap

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


class Brightness(torch.utils.data.Dataset[torch.Tensor]):
    """What a loop of one's own hands to torch's loader."""

    def __init__(self, photos: etsplat.Dataset) -> None:
        self.photos = photos

    def __len__(self) -> int:
        return len(self.photos.images)

    def __getitem__(self, view: int) -> torch.Tensor:
        return self.photos.images[view].float().mean()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_colmap(tmp_path / "scene", [(16, 12)] * 4)
    return tmp_path / "scene"


@pytest.mark.parametrize("start", ["fork", "spawn"])
def test_photos_of_a_folder_go_to_workers_of_a_loader(folder: Path, start: str) -> None:
    """Forked ones waited for ever, for threads that had stayed behind; others got none."""
    photos = etsplat.load_dataset(folder, preload=False)
    photos.images.expect(range(4))
    expected = torch.stack([photos.images[view].float().mean() for view in range(4)])
    loader = torch.utils.data.DataLoader(
        Brightness(photos), batch_size=2, num_workers=1, timeout=60, multiprocessing_context=start
    )
    assert torch.cat(list(loader)).equal(expected)


@pytest.mark.parametrize("how", [copy.deepcopy, lambda value: pickle.loads(pickle.dumps(value))])
def test_photos_that_are_yet_to_be_made_are_copied(how: Any, folder: Path) -> None:
    photos = etsplat.load_dataset(folder)
    for images in (photos.images, photos.images.subset([2, 1]), photos.halved().images):
        again = how(images)
        assert again.held_bytes == 0
        assert again.fingerprint() == images.fingerprint()
        assert all(one.equal(other) for one, other in zip(again, images, strict=True))


def test_photos_are_counted_and_say_what_they_are(folder: Path) -> None:
    images = etsplat.load_dataset(folder).images
    assert len(images) == 4
    assert repr(images) == "LazyPictures(4 of 16x12)"
    assert images[torch.tensor(-3)].equal(images[1])
    for photos in (images, PHOTOS.images):
        with pytest.raises(IndexError, match=r"must be a whole number, got slice: subset\(indices\) has several"):
            photos[0:2]
