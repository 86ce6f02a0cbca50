"""What `etsplat data sfm` and `etsplat data download` do."""

import builtins
import zipfile

import pytest

from captures import write_colmap, write_photo
from etsplat.core.errors import InputError
from etsplat.io import datasets
from etsplat.io.datasets import Dataset, download_dataset
from etsplat.scene.captures import load_capture
from etsplat.scene.structure_from_motion import find_cameras, undistort_scene


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
    with pytest.raises(InputError, match="no such folder"):
        find_cameras(tmp_path / "absent", tmp_path / "scene")
    write_photo(tmp_path / "photos" / "a.jpg", 16, 12)
    with pytest.raises(InputError, match="1 JPEG or PNG files"):
        find_cameras(tmp_path / "photos", tmp_path / "scene")
    for name in "bc":
        write_photo(tmp_path / "photos" / f"{name}.jpg", 16, 12)
    with pytest.raises(InputError, match="is there already"):
        find_cameras(tmp_path / "photos", tmp_path)


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
    capture = load_capture(found.scene)
    assert len(capture) == 5
    assert len(capture.points) == found.points > 100
    assert list(dict.fromkeys(phases)) == [
        "Finding features",
        "Comparing photos",
        "Placing cameras",
        "Removing lens distortion",
    ]


@pytest.mark.parametrize(("model", "extra"), [("SIMPLE_RADIAL", (-0.1,)), ("RADIAL", (0.05, -0.02))])
def test_a_distorted_scene_is_refused_with_the_remedy_and_undistorted_once(tmp_path, model, extra):
    pytest.importorskip("pycolmap")
    write_colmap(tmp_path / "scene", [(64, 48)] * 3, model=model, extra=extra)
    with pytest.raises(InputError, match=rf"{model}.*etsplat data undistort"):
        load_capture(tmp_path / "scene")
    undistort_scene(tmp_path / "scene", tmp_path / "new")
    capture = load_capture(tmp_path / "new")
    assert (len(capture), len(capture.points)) == (3, 20)
    assert all(abs(width / height - 64 / 48) < 0.2 for width, height in capture.images.sizes)
    (tmp_path / "scene" / "images" / "0001.jpg").unlink()
    with pytest.raises(InputError, match=r"1 images are missing \(first: 0001\.jpg\)"):
        undistort_scene(tmp_path / "scene", tmp_path / "newer")
    with pytest.raises(InputError, match="no sparse/0"):
        undistort_scene(tmp_path, tmp_path / "newer")


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
