"""Which photos get a camera, and what comes along with them."""

import math
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from PIL import Image

from etsplat.core.cameras import camera_centers
from etsplat.core.errors import InputError
from etsplat.data import colmap_process
from etsplat.data.load import load_dataset
from etsplat.data.structure_from_motion import find_cameras
from helpers.captures import write_photo
from helpers.photos import write_phone_photo


def test_photos_of_nothing_in_common_are_told_what_is_wrong_with_them(tmp_path):
    pytest.importorskip("pycolmap")
    for index in range(4):
        write_photo(tmp_path / "photos" / f"{index}.jpg", 64, 48, seed=index)
    with pytest.raises(InputError, match=r"only 0 of 4 could be placed.*overlapping"):
        find_cameras(tmp_path / "photos", tmp_path / "scene", threads=2)
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


def test_real_photos_become_a_scene_that_loads(tmp_path, shared_data):
    pytest.importorskip("pycolmap")
    (tmp_path / "photos").mkdir()
    for path in sorted((shared_data / "scenes" / "fountain-P11" / "images").iterdir())[2:7]:
        (tmp_path / "photos" / path.name).write_bytes(path.read_bytes())
    phases = []
    found = find_cameras(
        tmp_path / "photos",
        tmp_path / "scene",
        max_size=400,
        threads=2,
        progress=lambda phase, done, total: phases.append(phase),
    )
    assert (len(found.placed), found.unplaced) == (5, [])
    capture = load_dataset(found.scene)
    assert len(capture) == 5
    assert len(capture.points) == found.points > 100
    assert list(dict.fromkeys(phases)) == [
        "Reading photos",
        "Finding features",
        "Comparing photos",
        "Placing cameras",
        "Removing lens distortion",
    ]


def test_photos_of_two_phones_in_subfolders_become_one_scene(tmp_path, shared_data):
    """Stored on their side, one as HEIC, with EXIF; and cut to a longer focal length, without: two cameras, by the
    names of the photos with their folders, each with its own focal length, and poses as those of the plain photos."""
    pytest.importorskip("pycolmap")
    pytest.importorskip("pillow_heif")
    scene = shared_data / "scenes" / "fountain-P11"
    for index, path in enumerate(sorted((scene / "images").iterdir())[2:8]):
        upright = Image.open(path).convert("RGB")
        if index % 2:
            width, height = upright.size
            box = (0.125 * width, 0.125 * height, 0.875 * width, 0.875 * height)
            write_phone_photo(tmp_path / "photos" / "tele" / path.name, upright.resize((720, 480), box=box))
        else:
            name = path.with_suffix(".heic" if index == 4 else ".jpg").name
            tags = {"model": "X", "focal_35mm": 37}
            write_phone_photo(tmp_path / "photos" / "wide" / name, upright, (6, 8, 3)[index // 2], **tags)
    found = find_cameras(tmp_path / "photos", tmp_path / "scene", max_size=500, threads=2)
    assert (len(found.placed), found.unplaced, found.cameras) == (6, [], 2)
    assert found.placed[0].startswith("tele/")
    assert found.placed[-1].startswith("wide/")
    capture, truth = load_dataset(found.scene), load_dataset(scene)
    assert all(width > height for width, height in capture.images.sizes)
    angles = [2 * math.atan(w / 2 / float(K[0, 0])) for K, (w, _) in zip(capture.Ks, capture.images.sizes, strict=True)]
    assert max(angles[:3]) < 0.85 * min(angles[3:])
    order = [truth.names.index(Path(name).stem) for name in found.placed]
    assert distances_agree(camera_centers(capture.viewmats), camera_centers(truth.viewmats[order]))


def test_masks_of_a_plain_background_come_along(tmp_path, shared_data):
    """Here photos are cut to what lies in a circle, before white; one of them is not, and is left out by name."""
    pytest.importorskip("pycolmap")
    paths = sorted((shared_data / "scenes" / "fountain-P11" / "images").iterdir())
    (tmp_path / "photos").mkdir()
    for path in paths[2:8]:
        photo = np.asarray(Image.open(path).convert("RGB").resize((600, 400)))
        rows, columns = np.mgrid[:400, :600]
        inside = np.hypot(columns - 300, rows - 200) < 180
        white = photo if path == paths[7] else np.where(inside[..., None], photo, 245)
        Image.fromarray(white.astype(np.uint8)).save(tmp_path / "photos" / path.name, quality=95)
    found = find_cameras(tmp_path / "photos", tmp_path / "scene", masks="auto", threads=2)
    assert list(found.unmasked) == [paths[7].name]
    assert found.placed == [path.name for path in paths[2:7]]
    capture = load_dataset(found.scene)
    for view in range(len(capture)):
        mask, photo = capture.images.mask(view), capture.images[view]
        assert mask.shape == photo.shape[:2]
        expected = np.hypot(*(np.indices(mask.shape) - np.array(mask.shape)[:, None, None] / 2)) < 0.45 * mask.shape[0]
        assert ((mask >= 128).numpy() & expected).sum() / ((mask >= 128).numpy() | expected).sum() > 0.9
    with pytest.raises(InputError, match=r"which 11 of 11 photos lack"):
        find_cameras(paths[0].parent, tmp_path / "rooms", masks="auto")


def distances_agree(a, b):
    """Whether those between two lists of points are the same within 3 % but for the unit."""
    ratios = torch.pdist(a) / torch.pdist(b)
    return float(ratios.std() / ratios.mean()) < 0.03


def grain(places, seed, octaves=5):
    """Random brightness at places of a plane, (..., 2), with detail of all sizes."""
    rng, brightness = np.random.default_rng(seed), 0.0
    for octave in range(octaves):
        values, (x, y) = rng.random((128, 128)), np.moveaxis(places * 2**octave + 31, -1, 0)
        left, top = np.floor(x).astype(int), np.floor(y).astype(int)
        corners = [[values[(left + i) % 128, (top + j) % 128] for j in (0, 1)] for i in (0, 1)]
        along_x = [corners[0][j] * (1 - x + left) + corners[1][j] * (x - left) for j in (0, 1)]
        brightness = brightness + (along_x[0] * (1 - y + top) + along_x[1] * (y - top)) / 1.6**octave
    return brightness


def two_walls(center, size=(480, 360), focal=330.0):
    """Photo of a wall at a distance of 3, and of one at 6 beside it."""
    width, height = size
    y, x = np.mgrid[:height, :width] + 0.5
    rays = np.stack([x - width / 2, y - height / 2], axis=-1) / focal
    near, far = (rays * depth + np.array(center) for depth in (3.0, 6.0))
    gray = np.where((np.abs(near) < 1).all(axis=-1), grain(near * 2, 1), grain(far * 2, 2))
    return Image.fromarray((255 * (gray - gray.min()) / np.ptp(gray)).astype(np.uint8)).convert("RGB")


@pytest.mark.parametrize("how", ["transparent", "folder"])
def test_masks_that_photos_bring_along_are_in_the_scene(tmp_path, how):
    """Be they transparent around the object, or their masks in a folder among them, which are no photos then."""
    pytest.importorskip("pycolmap")
    (tmp_path / "photos" / ("masks" if how == "folder" else "")).mkdir(parents=True)
    y, x = np.mgrid[:360, :480] + 0.5
    inside = {}
    for index, shift in enumerate((-0.6, -0.2, 0.2, 0.6)):
        center = (shift, 0.3 * (-1) ** index)
        photo = two_walls(center, focal=400.0)
        inside[f"{index}.png"] = mask = (np.abs((x - 240) * 3 / 400 + center[0]) < 1) & (
            np.abs((y - 180) * 3 / 400 + center[1]) < 1
        )
        alpha = Image.fromarray(255 * mask.astype(np.uint8))
        if how == "transparent":
            photo.putalpha(alpha)
        else:
            alpha.save(tmp_path / "photos" / "masks" / f"{index}.png")
        photo.save(tmp_path / "photos" / f"{index}.png")
    found = find_cameras(tmp_path / "photos", tmp_path / "scene", threads=2)
    assert found.masked
    assert found.placed == sorted(inside)
    capture = load_dataset(found.scene)
    for view, name in enumerate(sorted(inside)):
        mask = capture.images.mask(view)
        truth = torch.from_numpy(inside[name])
        rows, columns = min(mask.shape[0], 360), min(mask.shape[1], 480)
        agree = (mask[:rows, :columns] >= 128) == truth[:rows, :columns]
        assert agree.float().mean() > 0.97


def test_photos_from_hardly_different_places_are_placed(tmp_path):
    """By a wide lens: with the focal length that is guessed, no two photos differ by 16 degrees."""
    pytest.importorskip("pycolmap")
    (tmp_path / "photos").mkdir()
    centers = [(x, y) for x in (-0.25, 0.0, 0.25) for y in (-0.125, 0.125)]
    for index, center in enumerate(centers):
        two_walls(center).save(tmp_path / "photos" / f"{index}.png")
    found = find_cameras(tmp_path / "photos", tmp_path / "scene", threads=2)
    assert len(found.placed) == len(centers)
    capture = load_dataset(found.scene)
    truth = torch.tensor([(*center, 0.0) for center in centers])
    assert distances_agree(camera_centers(capture.viewmats), truth)


@pytest.mark.parametrize(("in_order", "widens", "every_pair"), [(4, True, True), (4, False, False), (6, True, False)])
def test_every_pair_is_compared_where_the_order_of_names_says_little(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, in_order: int, widens: bool, every_pair: bool
) -> None:
    """Of 135 pictures by many people 4 were placed, whatever they showed."""
    colmap, names = MagicMock(), [f"{index}.jpg" for index in range(12)]
    monkeypatch.setattr(colmap_process, "import_pycolmap", lambda: colmap)
    written = []

    def models(*_: object, **__: object) -> dict[int, MagicMock]:
        found = MagicMock()
        found.num_reg_images.return_value = placed = 12 if colmap.match_exhaustive.called else in_order
        found.write.side_effect = lambda _: written.append(placed)
        return {0: found}

    colmap.incremental_mapping.side_effect = models
    job = colmap_process.Job(tmp_path, [names], tmp_path, False, widens, "incremental", 640, 1, None)
    assert colmap_process.place_photos(lambda *_: None, job) == tmp_path / "largest"
    assert colmap.match_sequential.called
    assert colmap.match_exhaustive.called == every_pair
    assert written == [12 if every_pair else in_order]
