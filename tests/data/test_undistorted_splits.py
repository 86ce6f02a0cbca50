"""What a capture says of itself beside its photos comes along where lens distortion is removed, or is told to stay."""

import json

import pytest

from etsplat.cli.parse import parse
from etsplat.core.errors import InputError
from etsplat.data.load import load_dataset
from etsplat.data.undistortion import undistort_scene
from helpers.captures import write_colmap, write_photo, write_transforms

NAMES = [f"images/{index:04d}.png" for index in range(6)]


def names_of(dataset, indices):
    return [dataset.names[index] for index in indices]


def test_a_split_of_the_capture_is_that_of_the_new_scene(tmp_path):
    pytest.importorskip("pycolmap")
    write_transforms(
        tmp_path / "scene", 6, width=64, height=48, k1=-0.1, train_filenames=NAMES[:3], test_filenames=NAMES[3:5]
    )
    told = []
    assert undistort_scene(tmp_path / "scene", tmp_path / "new", tell=told.append) == [n[7:] for n in NAMES[:5]]
    new = load_dataset(tmp_path / "new")
    assert (names_of(new, new.train), names_of(new, new.test)) == (["0000", "0001", "0002"], ["0003", "0004"])
    assert told == ["1 of 6 photos are named neither for training nor for testing and are left out"]


def test_none_for_testing_stays_none(tmp_path):
    pytest.importorskip("pycolmap")
    write_transforms(tmp_path / "scene", 6, width=64, height=48, k1=-0.1, train_filenames=NAMES, test_filenames=[])
    undistort_scene(tmp_path / "scene", tmp_path / "new")
    new = load_dataset(tmp_path / "new")
    assert (len(new.train), new.test) == (6, [])


def test_photos_for_testing_beside_a_model_of_colmap_come_along(tmp_path):
    """As 3DGS names them, sparse/0/test.txt; without it every 8th is tested, in the new scene too."""
    pytest.importorskip("pycolmap")
    write_colmap(tmp_path / "scene", [(64, 48)] * 4, model="SIMPLE_RADIAL", extra=(-0.1,))
    undistort_scene(tmp_path / "scene", tmp_path / "eighth")
    assert load_dataset(tmp_path / "eighth").test == [0]
    (tmp_path / "scene" / "sparse" / "0" / "test.txt").write_text("0002.jpg\n0003.jpg\n")
    undistort_scene(tmp_path / "scene", tmp_path / "new")
    new = load_dataset(tmp_path / "new")
    assert (new.train, new.test) == ([0, 1], [2, 3])


def test_names_for_testing_that_no_image_has_are_refused(tmp_path):
    write_colmap(tmp_path, [(64, 48)] * 4)
    (tmp_path / "sparse" / "0" / "test.txt").write_text("a.jpg\n")
    with pytest.raises(InputError, match=r"test\.txt: names none of the images; correct or remove it"):
        load_dataset(tmp_path)
    (tmp_path / "sparse" / "0" / "test.txt").write_text("".join(f"{index:04d}.jpg\n" for index in range(4)))
    with pytest.raises(InputError, match=r"test\.txt: names all images, none is left for training; correct"):
        load_dataset(tmp_path)


def test_the_command_says_what_is_left_out(tmp_path, capsys):
    pytest.importorskip("pycolmap")
    write_transforms(tmp_path / "scene", 6, width=64, height=48)
    for name in NAMES:
        write_photo(tmp_path / "scene" / "depths" / name[7:], 64, 48)
    document = json.loads((tmp_path / "scene" / "transforms.json").read_text())
    (tmp_path / "scene" / "transforms.json").write_text(json.dumps({**document, "train_filenames": NAMES[:2]}))
    arguments = ["data", "undistort", str(tmp_path / "scene"), "--out", str(tmp_path / "new")]
    assert parse(arguments).run(arguments) == 0
    said = capsys.readouterr().out
    assert "every 8th of all photos is tested" in said
    assert "depths/ stays behind" in said
    assert "no photo has lens distortion: the scene can be used as it was" in said
