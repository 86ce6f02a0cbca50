"""What `etsplat data sfm` and `etsplat data download` do."""

import builtins
import contextlib
import math
import os
import shutil
import signal
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from etsplat.core.cameras import camera_centers
from etsplat.core.errors import InputError
from etsplat.data.load import load_dataset
from etsplat.data.structure_from_motion import find_cameras
from etsplat.data.undistortion import undistort_scene, working_folder
from etsplat.io import datasets
from etsplat.io.datasets import Dataset, download_dataset
from helpers.captures import circle_poses, write_colmap, write_photo, write_transforms
from helpers.photos import write_phone_photo


def test_without_pycolmap_the_extra_is_named(tmp_path, monkeypatch):
    real = builtins.__import__

    def refuse(name, *args, **kwargs):
        if name == "pycolmap":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(InputError, match=r"etsplat\[sfm\]"):
        find_cameras(tmp_path, tmp_path / "scene")


def test_folders_that_cannot_be_used_are_input_errors(tmp_path):
    pytest.importorskip("pycolmap")
    with pytest.raises(InputError, match="no such file or folder"):
        find_cameras(tmp_path / "absent", tmp_path / "scene")
    write_photo(tmp_path / "photos" / "a.jpg", 16, 12)
    with pytest.raises(InputError, match="1 JPEG, PNG or HEIC files"):
        find_cameras(tmp_path / "photos", tmp_path / "scene")
    for name in "bc":
        write_photo(tmp_path / "photos" / f"{name}.jpg", 16, 12)
    for photos, out in (("photos", "photos/a.jpg/scene"), ("photos/a.jpg", "scene")):
        with pytest.raises(InputError, match=r"is one photo; name the folder|a file is in the way"):
            find_cameras(tmp_path / photos, tmp_path / out)
    (tmp_path / "photos.zip").write_bytes(b"PK")
    for read in (lambda path: find_cameras(path, tmp_path / "scene"), load_dataset):
        with pytest.raises(InputError, match=r"photos\.zip: is an archive; unpack it and name the folder"):
            read(tmp_path / "photos.zip")
    with pytest.raises(InputError, match=r"scene .*/photoz: no such folder; did you mean .*/photos\?"):
        undistort_scene(tmp_path / "photoz", tmp_path / "scene")
    with pytest.raises(InputError, match="is there already"):
        find_cameras(tmp_path / "photos", tmp_path)
    with pytest.raises(InputError, match="lies in the folder of the photos"):
        find_cameras(tmp_path / "photos", tmp_path / "photos" / "scene")
    with pytest.raises(InputError, match="max_size: is 0; it must be at least 16"):
        find_cameras(tmp_path / "photos", tmp_path / "scene", max_size=0)


def test_a_disk_too_small_is_found_before_it_is_full(tmp_path, monkeypatch):
    pytest.importorskip("pycolmap")
    for name in "abc":
        write_photo(tmp_path / "photos" / f"{name}.jpg", 16, 12)
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=8 << 20))
    with pytest.raises(InputError, match=r"3 images may take 10 MiB there and 8 MiB are free"):
        find_cameras(tmp_path / "photos", tmp_path / "scene")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=1 << 20))
    write_colmap(tmp_path / "distorted", [(64, 48)] * 3, model="SIMPLE_RADIAL", extra=(-0.1,))
    with pytest.raises(InputError, match=r"3 images may take 1 MiB there"):
        undistort_scene(tmp_path / "distorted", tmp_path / "new")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["distorted", "photos"]


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


@pytest.mark.parametrize(("model", "extra"), [("SIMPLE_RADIAL", (-0.1,)), ("RADIAL", (0.05, -0.02))])
def test_a_distorted_scene_is_refused_with_the_remedy_and_undistorted_once(tmp_path, model, extra):
    pytest.importorskip("pycolmap")
    write_colmap(tmp_path / "scene", [(64, 48)] * 3, model=model, extra=extra)
    with pytest.raises(InputError, match=rf"{model}.*etsplat data undistort"):
        load_dataset(tmp_path / "scene")
    undistort_scene(tmp_path / "scene", tmp_path / "new")
    capture = load_dataset(tmp_path / "new")
    assert (len(capture), len(capture.points)) == (3, 20)
    assert all(abs(width / height - 64 / 48) < 0.2 for width, height in capture.images.sizes)
    (tmp_path / "scene" / "images" / "0001.jpg").unlink()
    with pytest.raises(InputError, match=r"1 images are missing \(first: 0001\.jpg\)"):
        undistort_scene(tmp_path / "scene", tmp_path / "newer")
    with pytest.raises(InputError, match=r"none of .* sparse/"):
        undistort_scene(tmp_path, tmp_path / "newer")


def test_smaller_copies_with_other_endings_are_undistorted_as_they_would_be_read(tmp_path):
    """Whose masks have the size that the model is for; the smaller copy is what the large photo is, shrunk."""
    pytest.importorskip("pycolmap")
    for name, size in (("large", (160, 120)), ("small", (80, 60))):
        scene = tmp_path / name
        write_colmap(scene, [(160, 120)] * 3, model="SIMPLE_RADIAL", extra=(-0.1,))
        for index in range(3):
            (scene / "images" / f"{index:04d}.jpg").unlink()
            file = f"{index:04d}.JPG" if name == "large" or index else "0000.png"
            write_photo(scene / "images" / file, *size, seed=index)
            write_photo(scene / "masks" / f"{index:04d}.png", 160, 120, seed=9)
    assert undistort_scene(tmp_path / "small", tmp_path / "new") == ["0000.png", "0001.JPG", "0002.JPG"]
    undistort_scene(tmp_path / "large", tmp_path / "new large")
    small, large = load_dataset(tmp_path / "new"), load_dataset(tmp_path / "new large", width=80)
    assert len(small.points) == 20
    torch.testing.assert_close(small.viewmats, large.viewmats)
    for index in range(3):
        width = small.images.sizes[index][0]
        assert 70 < width < 90
        assert abs(small.Ks[index, 0, 0] / width - large.Ks[index, 0, 0] / 80) < 0.02
        assert abs(float(small.images[index].float().mean() - large.images[index].float().mean())) < 3
        assert abs(float(small.images.mask(index).float().mean() - large.images.mask(index).float().mean())) < 3
    write_photo(tmp_path / "small" / "images" / "0001.JPG", 80, 80)
    with pytest.raises(InputError, match=r"0001\.jpg is 80x80, but its camera is for 160x120"):
        undistort_scene(tmp_path / "small", tmp_path / "newer")


@pytest.mark.parametrize("file", ["images/0001.jpg", "masks/0001.png"])
def test_pictures_cut_short_are_not_undistorted(tmp_path, file):
    pytest.importorskip("pycolmap")
    write_colmap(tmp_path / "scene", [(64, 48)] * 3, model="SIMPLE_RADIAL", extra=(-0.1,))
    for index in range(3):
        write_photo(tmp_path / "scene" / "masks" / f"{index:04d}.png", 64, 48, seed=index)
    path = tmp_path / "scene" / file
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match=rf"{file}: damaged or cut short .*; copy it again"):
        undistort_scene(tmp_path / "scene", tmp_path / "new")


LENSES = {
    "OPENCV": {"k1": -0.2, "k2": 0.05, "p1": 0.01, "p2": -0.02},
    "OPENCV_FISHEYE": {"k1": -0.05, "k2": 0.02, "k3": -0.01, "k4": 0.002},
}


def distorted(x, y, model, k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0, k4=0.0):
    """OpenCV's models, on the plane z = 1."""
    r2 = x * x + y * y
    if model == "OPENCV_FISHEYE":
        angle = math.atan(math.sqrt(r2))
        scale = angle * (1 + k1 * angle**2 + k2 * angle**4 + k3 * angle**6 + k4 * angle**8) / math.sqrt(r2)
        return x * scale, y * scale
    radial = 1 + k1 * r2 + k2 * r2 * r2
    return x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y


@pytest.mark.parametrize("model", LENSES)
def test_distortion_of_transforms_json_is_removed_once(tmp_path, model):
    """A dot photographed through the lens is afterwards where the camera without lens sees it; the mask comes along."""
    pytest.importorskip("pycolmap")
    write_transforms(
        tmp_path / "scene", 3, width=160, height=120, fl_y=150, cx=83, cy=58, camera_model=model, **LENSES[model]
    )
    with pytest.raises(InputError, match="etsplat data undistort"):
        load_dataset(tmp_path / "scene")
    ray = (0.3, -0.2)
    u, v = distorted(*ray, model, **LENSES[model])
    rows, columns = np.mgrid[:120, :160] + 0.5
    squares = (columns - (160 * u + 83)) ** 2 + (rows - (150 * v + 58)) ** 2
    dot = (255 * np.exp(-squares / 8)).astype(np.uint8)
    for index in range(3):
        Image.fromarray(np.repeat(dot[..., None], 3, axis=2)).save(tmp_path / "scene" / "images" / f"{index:04d}.png")
        (tmp_path / "scene" / "masks").mkdir(exist_ok=True)
        Image.fromarray(dot).save(tmp_path / "scene" / "masks" / f"{index:04d}.png")
    assert undistort_scene(tmp_path / "scene", tmp_path / "new") == ["0000.png", "0001.png", "0002.png"]
    capture = load_dataset(tmp_path / "new")
    expected = (capture.Ks[1] @ torch.tensor([*ray, 1.0], dtype=torch.float64))[:2]
    for picture in (capture.images[1][..., 0], capture.images.mask(1)):
        weight = picture.double()
        x = (weight.sum(dim=0) * (torch.arange(picture.shape[1]) + 0.5)).sum() / weight.sum()
        y = (weight.sum(dim=1) * (torch.arange(picture.shape[0]) + 0.5)).sum() / weight.sum()
        torch.testing.assert_close(torch.stack([x, y]), expected, atol=0.3, rtol=0)
    torch.testing.assert_close(capture.viewmats[1], circle_poses(3)[1], atol=1e-6, rtol=0)


@pytest.mark.parametrize("layout", ["transforms.json", "COLMAP"])
def test_photos_that_lie_on_their_side_are_undistorted_upright(tmp_path, layout):
    """As EXIF says, where their cameras do not lie: the same pictures as of photos that are stored upright."""
    pytest.importorskip("pycolmap")
    for name in ("stored", "upright"):
        scene = tmp_path / name
        if layout == "COLMAP":
            write_colmap(scene, [(64, 48)] * 3, model="RADIAL", extra=(0.05, -0.02))
        else:
            write_transforms(scene, 3, width=64, height=48, fl_y=60, camera_model="OPENCV", **LENSES["OPENCV"])
        for index, path in enumerate(sorted((scene / "images").iterdir())):
            picture = Image.linear_gradient("L").resize((64, 48)).rotate(30 * index).convert("RGB")
            write_phone_photo(path, picture, 6 if name == "stored" and index else 1)
        undistort_scene(scene, tmp_path / f"new {name}")
    stored, upright = (load_dataset(tmp_path / f"new {name}") for name in ("stored", "upright"))
    assert stored.images.sizes == upright.images.sizes
    for index in range(3):  # JPEG has lost some of 255 twice
        assert float((stored.images[index].float() - upright.images[index].float()).abs().mean()) < 3


def test_transparency_that_undistortion_would_lose_is_refused(tmp_path):
    pytest.importorskip("pycolmap")
    write_transforms(tmp_path / "scene", 3, channels=4, k1=-0.1)
    with pytest.raises(InputError, match=r"0000\.png: has transparency.*masks"):
        undistort_scene(tmp_path / "scene", tmp_path / "new")


def test_lenses_that_programs_disagree_about_are_refused(tmp_path):
    pytest.importorskip("pycolmap")
    unknown = [{"k4": 0.1}, {"is_fisheye": True, "p1": 0.1}, {"camera_model": "RADIAL", "k5": 0.1}]
    for number, settings in enumerate(unknown):
        write_transforms(tmp_path / str(number), 3, **settings)
        with pytest.raises(InputError, match="coefficients that are not known here"):
            undistort_scene(tmp_path / str(number), tmp_path / "new")


@pytest.fixture
def file_size_limit():
    """Makes the operating system refuse larger files, as a full disk refuses any; in new processes too."""
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_disk_that_is_full_all_of_a_sudden_is_one_line_and_nothing_stays(tmp_path, file_size_limit):
    """COLMAP raises or ends its process where its database cannot grow; so does libjpeg with an image."""
    pytest.importorskip("pycolmap")
    for index in range(3):
        write_photo(tmp_path / "photos" / f"{index}.png", 320, 240, seed=index)
    write_colmap(tmp_path / "scene", [(640, 480)] * 3, model="SIMPLE_RADIAL", extra=(-0.1,))
    file_size_limit(100_000)
    with pytest.raises(
        InputError, match=r"cannot write .*/new: COLMAP failed \((a sudden end, exit status -6|No registered database)"
    ) as raised:
        find_cameras(tmp_path / "photos", tmp_path / "new", threads=1)
    assert "\n" not in str(raised.value)
    file_size_limit(8_000)
    with pytest.raises(
        InputError, match=r"cannot write .*/new: COLMAP failed \((a sudden end|\d of 3 images could)"
    ) as raised:
        undistort_scene(tmp_path / "scene", tmp_path / "new")
    assert "\n" not in str(raised.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["photos", "scene"]


APART = """
import os
import time

from etsplat.data.colmap_process import run_apart


def work(report):
    report("here", os.getpid(), 0)
    time.sleep(100)


if __name__ == "__main__":
    run_apart(work, report=lambda phase, done, total: print(done, flush=True))
"""


def test_colmap_ends_with_the_process_that_started_it(tmp_path):
    """Also where that is killed, and can end nothing itself."""
    pytest.importorskip("pycolmap")
    (tmp_path / "apart.py").write_text(APART)
    process = subprocess.Popen([sys.executable, "apart.py"], cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    colmap = int(process.stdout.readline())
    process.kill()
    try:
        process.communicate(timeout=10)  # which waits for both: they have the same standard output
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(colmap, signal.SIGKILL)


ABANDONING = """
import sys
from pathlib import Path

from etsplat.data.undistortion import working_folder

with working_folder(Path("scene")) as work:
    (work / "database.db").write_text("large")
    print(work, flush=True)
    sys.stdin.read()
"""


def test_what_a_killed_process_left_is_removed_by_the_next_for_the_same_folder(tmp_path):
    """And by no other; that of a living process stays, as does a hidden folder of somebody else."""
    for name in (".scene-notes", ".other-12"):
        (tmp_path / name).mkdir()
    program = [sys.executable, "-c", ABANDONING]
    pipe = subprocess.PIPE
    killed, living = (subprocess.Popen(program, cwd=tmp_path, stdin=pipe, stdout=pipe, text=True) for _ in range(2))
    try:
        left, used = (tmp_path / process.stdout.readline().strip() for process in (killed, living))
        killed.kill()
        killed.communicate()
        assert left.is_dir()
        with working_folder(tmp_path / "another"):
            assert left.is_dir()
        with working_folder(tmp_path / "scene") as work:
            assert not left.exists()
            assert (used / "database.db").is_file()
            assert sorted(tmp_path.iterdir()) == sorted([tmp_path / ".scene-notes", tmp_path / ".other-12", used, work])
    finally:
        killed.kill()
        living.communicate()  # ends it
    assert sorted(path.name for path in tmp_path.iterdir()) == [".other-12", ".scene-notes"]


@pytest.fixture
def archive(tmp_path, monkeypatch):
    path = tmp_path / "archive.zip"
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("truck/sparse/0/cameras.txt", "")
    monkeypatch.setitem(datasets.DATASETS, "tiny", Dataset(path.as_uri(), ("truck",), 0.001))
    return path


def test_a_data_set_is_fetched_once(tmp_path, archive):
    done = []
    assert download_dataset("tiny", tmp_path / "data", progress=lambda *state: done.append(state)) == [
        tmp_path / "data" / "truck"
    ]
    assert done[-1] == (archive.stat().st_size, archive.stat().st_size)
    assert [path.name for path in (tmp_path / "data").iterdir()] == ["truck"]
    archive.unlink()
    download_dataset("tiny", tmp_path / "data")


def test_without_a_network_the_address_is_told(tmp_path, monkeypatch):
    monkeypatch.setitem(datasets.DATASETS, "tiny", Dataset("http://127.0.0.1:9/a.zip", ("truck",), 0.001))
    with pytest.raises(InputError, match=r"cannot reach http://127\.0\.0\.1:9/a\.zip.*unpack it into"):
        download_dataset("tiny", tmp_path / "data")
    (tmp_path / "no.zip").write_text("not a zip")
    monkeypatch.setitem(datasets.DATASETS, "tiny", Dataset((tmp_path / "no.zip").as_uri(), ("truck",), 0.001))
    with pytest.raises(InputError, match="damaged"):
        download_dataset("tiny", tmp_path / "data")


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
