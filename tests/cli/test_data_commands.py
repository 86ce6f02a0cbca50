"""What `etsplat data` refuses, and what is left where it is ended."""

import builtins
import contextlib
import os
import shutil
import signal
import subprocess
import sys

import pytest
from PIL import Image, ImageDraw

from etsplat.core.errors import InputError
from etsplat.data.load import load_dataset
from etsplat.data.structure_from_motion import find_cameras
from etsplat.data.undistortion import undistort_scene, working_folder
from helpers.captures import write_colmap, write_photo
from helpers.commands import assert_one_line_error


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


def test_masks_say_what_told_the_object_from_the_rest(tmp_path, etsplat):
    write_colmap(tmp_path / "scene", [(90, 60)] * 3)
    for index in range(3):
        picture = Image.new("RGB", (90, 60), (245, 245, 245))
        ImageDraw.Draw(picture).ellipse((30 + index, 15, 60 + index, 45), fill=(230, 120, 20))
        picture.save(tmp_path / "scene" / "images" / f"{index:04d}.jpg", quality=95)
    arguments = ("data", "masks", str(tmp_path / "scene"), "--out", str(tmp_path / "masks"))
    done = etsplat(*arguments)
    assert done.returncode == 0, done.stderr
    assert f"3 masks in {tmp_path / 'masks'}, by a plain background" in done.stdout
    assert_one_line_error(etsplat(*arguments), "is there already")
