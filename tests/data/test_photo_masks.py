"""Masks of photos, written for those that have a plain background."""

import json

import numpy as np
import pytest
from PIL import Image

from etsplat.core.errors import InputError
from etsplat.data.frames import Wanted
from etsplat.data.load import format_of
from etsplat.data.photo_masks import mask_file, write_masks
from etsplat.tasks.object_masks import MaskedPhotos, mask_capture
from helpers.captures import write_colmap, write_photo, write_transforms
from helpers.foreign_captures import WRITERS, truth


def write_disc(path, center):
    """An orange disc before white, 90 x 60."""
    rows, columns = np.mgrid[:60, :90]
    inside = np.hypot(columns - center, rows - 30) < 18
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.where(inside[..., None], (230, 120, 20), (245, 245, 245)).astype(np.uint8)).save(path)
    return inside


def test_masks_have_the_names_and_sizes_of_the_photos_and_photos_without_are_named(tmp_path):
    names = ["a/1.png", "a/2.png", "b/1.png"]
    discs = [write_disc(tmp_path / "photos" / name, 30 + 10 * k) for k, name in enumerate(names)]
    write_photo(tmp_path / "photos" / "room.jpg", 90, 60)
    told = []
    refused = write_masks(
        {name: tmp_path / "photos" / name for name in [*names, "room.jpg"]},
        tmp_path / "masks",
        lambda *state: told.append(state),
    )
    assert list(refused) == ["room.jpg"]
    for name, disc in zip(names, discs, strict=True):
        mask = np.asarray(Image.open(mask_file(tmp_path / "masks", name))) >= 128
        assert (mask & disc).sum() / (mask | disc).sum() > 0.93
    assert not mask_file(tmp_path / "masks", "room.jpg").exists()
    assert told[-1] == ("Masking", 4, 4)


def test_a_capture_without_plain_backgrounds_is_refused_as_a_whole(tmp_path):
    """Three of four photos: the message names one with its reason."""
    write_disc(tmp_path / "0.png", 40)
    for index in (1, 2, 3):
        write_photo(tmp_path / f"{index}.png", 90, 60, seed=index)
    with pytest.raises(InputError, match=r"3 of 4 photos lack \(1\.png: .*\); leave the masks out") as raised:
        write_masks({f"{k}.png": tmp_path / f"{k}.png" for k in range(4)}, tmp_path / "masks", lambda *state: None)
    assert "\n" not in str(raised.value)


def write_split(folder):
    """As NeRF synthetic: photos for training and for testing have the same names in folders of their own."""
    write_transforms(folder, 4)
    document = json.loads((folder / "transforms.json").read_text())
    (folder / "transforms.json").unlink()
    for part, frames in (("train", document["frames"][:3]), ("test", document["frames"][3:])):
        for index, frame in enumerate(frames):
            frame["file_path"] = f"{part}/r_{index}.png"
        (folder / f"transforms_{part}.json").write_text(json.dumps({**document, "frames": frames}))


@pytest.mark.parametrize("kind", [*WRITERS, "colmap", "nerf"])
def test_masks_of_a_capture_are_found_by_the_reader_of_its_layout(tmp_path, kind):
    """Each photo gets its own, also where training and test photos have the same names."""
    scene = tmp_path / "scene"
    scene.mkdir()
    if kind in WRITERS:
        WRITERS[kind](scene, truth(centered=kind == "bundler"))
    elif kind == "colmap":
        write_colmap(scene, [(90, 60)] * 4)
    else:
        write_split(scene)
    frames = format_of(scene).list_frames(scene, Wanted()).frames
    for index, frame in enumerate(frames):
        write_disc(frame.image, 30 + 5 * index)
    assert mask_capture(scene, tmp_path / "masks") == MaskedPhotos(len(frames), "background", {})
    found = format_of(scene).list_frames(scene, Wanted(masks=tmp_path / "masks")).frames
    for index, frame in enumerate(found):
        rows, columns = np.mgrid[:60, :90]
        mask = np.asarray(Image.open(frame.mask)) >= 128
        disc = np.hypot(columns - 30 - 5 * index, rows - 30) < 18
        assert (mask & disc).sum() / (mask | disc).sum() > 0.9
