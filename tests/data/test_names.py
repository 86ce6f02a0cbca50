"""Names in captures lead to files of the capture and to nothing else, for reading and for writing."""

import json
import shutil

import pytest

from etsplat.core.errors import InputError
from etsplat.data.load import load_dataset
from etsplat.data.undistortion import undistort_scene
from helpers.captures import write_colmap, write_photo, write_transforms

OUTSIDE = "../../stolen.jpg"


def rename_first(path, name):
    text = path.read_text()
    path.write_text(text.replace("0000.jpg", name, 1))


@pytest.fixture
def colmap(tmp_path):
    """A model whose first image is a real file outside of the scene."""
    scene = tmp_path / "deep" / "scene"
    write_colmap(scene, [(32, 24)] * 4, model="SIMPLE_RADIAL", extra=[0.01])
    write_photo(tmp_path / "deep" / "stolen.jpg", 32, 24)
    rename_first(scene / "sparse" / "0" / "images.txt", OUTSIDE)
    return scene


def test_undistortion_writes_nothing_outside_of_its_folder(tmp_path, colmap):
    pytest.importorskip("pycolmap")
    before = sorted(path for path in tmp_path.rglob("*"))
    with pytest.raises(InputError, match=r"sparse/0: '\.\./\.\./stolen\.jpg' leads out of .*/images"):
        undistort_scene(colmap, tmp_path / "out" / "deep" / "er")
    assert [path for path in sorted(tmp_path.rglob("*")) if path.suffix] == [path for path in before if path.suffix]


def test_a_model_reads_nothing_outside_of_its_folder(tmp_path, colmap):
    shutil.rmtree(colmap)
    write_colmap(colmap, [(32, 24)] * 4)
    rename_first(colmap / "sparse" / "0" / "images.txt", OUTSIDE)
    with pytest.raises(InputError, match=r"sparse/0: '\.\./\.\./stolen\.jpg' leads out"):
        load_dataset(colmap)


@pytest.mark.parametrize("key", ["file_path", "mask_path", "ply_file_path"])
@pytest.mark.parametrize("name", ["../stolen.png", "/stolen.png", "..\\stolen.png"])
def test_transforms_read_nothing_outside_of_their_folder(tmp_path, key, name):
    scene = tmp_path / "scene"
    write_transforms(scene, 4)
    write_photo(tmp_path / "stolen.png", 32, 24)
    path = scene / "transforms.json"
    document = json.loads(path.read_text())
    (document if key == "ply_file_path" else document["frames"][1])[key] = name
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"transforms\.json: '.*stolen\.png' leads out of .*/scene"):
        load_dataset(scene)
