"""Names in captures lead to files of the capture and to nothing else, for reading and for writing."""

import json
import shutil
import unicodedata

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
    with pytest.raises(InputError, match=r"1 images are missing \(first: \.\./\.\./stolen\.jpg\)"):
        undistort_scene(colmap, tmp_path / "out" / "deep" / "er")
    assert [path for path in sorted(tmp_path.rglob("*")) if path.suffix] == [path for path in before if path.suffix]


def test_a_model_reads_nothing_outside_of_its_folder(tmp_path, colmap):
    shutil.rmtree(colmap)
    write_colmap(colmap, [(32, 24)] * 4)
    rename_first(colmap / "sparse" / "0" / "images.txt", OUTSIDE)
    with pytest.raises(InputError, match=r"1 of 4 images are missing \(first: .*/scene/images/stolen\.jpg\)"):
        load_dataset(colmap)


@pytest.mark.parametrize("key", ["file_path", "mask_path", "ply_file_path"])
@pytest.mark.parametrize("name", ["../stolen.png", "/stolen.png", "..\\stolen.png"])
def test_transforms_read_nothing_outside_of_their_folder(tmp_path, key, name):
    scene = tmp_path / "deep" / "scene"
    write_transforms(scene, 4)
    write_photo(tmp_path / "deep" / "stolen.png", 32, 24)
    path = scene / "transforms.json"
    document = json.loads(path.read_text())
    (document if key == "ply_file_path" else document["frames"][1])[key] = name
    path.write_text(json.dumps(document))
    with pytest.raises(
        InputError,
        match=r"(missing|image|PLY file).*/deep/scene/(images/)?stolen\.png(: no such file|\);)|outside of its folder",
    ):
        load_dataset(scene)


ELSEWHERE = {
    "absolute": "{scene}/images/{name}",
    "another computer": "/mnt/me/cap/images/{name}",
    "Windows": "C:\\Users\\me\\cap\\images\\{name}",
    "up": "../cap/images/{name}",
    "bare": "{name}",
    "stem": "{stem}",
    "own": "images/{name}",
}


@pytest.mark.parametrize("place", ELSEWHERE)
def test_photos_are_found_by_the_end_of_their_path_in_transforms(tmp_path, place):
    """So are the points, the masks and the copies of --images; the split names photos the same way."""
    write_transforms(tmp_path, 4)
    shutil.copytree(tmp_path / "images", tmp_path / "masks")
    shutil.copytree(tmp_path / "images", tmp_path / "images_2")
    path = tmp_path / "transforms.json"
    document = json.loads(path.read_text())
    for index, frame in enumerate(document["frames"]):
        told = ELSEWHERE[place].format(scene=tmp_path, name=f"{index:04d}.png", stem=f"{index:04d}")
        frame |= {"file_path": told, "mask_path": told.replace("images", "masks") + (".png" if place == "stem" else "")}
    if place in ("bare", "stem"):  # which say no folder of masks
        for frame in document["frames"]:
            del frame["mask_path"]
    names = [frame["file_path"] for frame in document["frames"]]
    (tmp_path / "points.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
        "end_header\n1 2 3\n"
    )
    document |= {"ply_file_path": "/mnt/me/cap/points.ply", "train_filenames": names[:3], "test_filenames": names[3:]}
    path.write_text(json.dumps(document))
    found = load_dataset(tmp_path)
    folder = "" if place in ("bare", "stem") else "images_"
    assert found.names == [f"{folder}{index:04d}" for index in range(4)]
    assert (found.train, found.test) == ([0, 1, 2], [3])
    assert found.points.tolist() == [[1, 2, 3]]
    assert found.images.mask(2) is not None
    again = load_dataset(tmp_path, images="images_2")
    assert again.names == found.names
    assert (again.images[1] == found.images[1]).all()


@pytest.mark.parametrize(
    ("folder", "place"), [(folder, place) for folder in ("images", ".") for place in ELSEWHERE if place != "own"]
)
def test_photos_are_found_by_the_end_of_their_path_in_colmaps_models(tmp_path, place, folder):
    """Beside sparse/ as well as in images/; undistortion finds the same."""
    pytest.importorskip("pycolmap")
    scene, names = tmp_path / "scene", [f"{index:04d}.jpg" for index in range(4)]
    write_colmap(scene, [(32, 24)] * 4, image_folder=folder)
    images = scene / "sparse" / "0" / "images.txt"
    for name in names:
        new = ELSEWHERE[place].format(scene=scene, name=name, stem=name.removesuffix(".jpg"))
        images.write_text(images.read_text().replace(f" {name}", f" {new}"))
    found = load_dataset(scene)
    assert [name.removeprefix("images_") for name in found.names] == ["0000", "0001", "0002", "0003"]
    undistort_scene(scene, tmp_path / "new")
    assert sorted(path.name for path in (tmp_path / "new" / "images").iterdir()) == names


def test_two_names_that_lead_to_one_file_are_refused(tmp_path):
    write_colmap(tmp_path, [(32, 24)] * 4)
    path = tmp_path / "sparse" / "0" / "images.txt"
    path.write_text(path.read_text().replace("0000.jpg", "/a/0000.jpg").replace("0001.jpg", "/b/0000.jpg"))
    with pytest.raises(InputError, match=r"2 frames have the image 0000\.jpg; keep one"):
        load_dataset(tmp_path)


@pytest.mark.parametrize("other", ["0000.png", "other/0000.png"])
def test_no_other_photo_takes_the_place_of_one_that_is_missing(tmp_path, other):
    """Nor a photo that of a mask: a name that does not lead out of the capture is the name of that file alone."""
    write_transforms(tmp_path, 4)
    (tmp_path / other).parent.mkdir(exist_ok=True)
    shutil.move(tmp_path / "images" / "0000.png", tmp_path / other)
    with pytest.raises(InputError, match="1 of 4 images are missing"):
        load_dataset(tmp_path)
    shutil.move(tmp_path / other, tmp_path / "images" / "0000.png")
    path = tmp_path / "transforms.json"
    document = json.loads(path.read_text())
    for told in ("masks/0000.png", "/mnt/me/cap/masks/0000.png"):
        document["frames"][0]["mask_path"] = told
        path.write_text(json.dumps(document))
        with pytest.raises(InputError, match="no such file"):
            _ = load_dataset(tmp_path).images[0]


def test_views_have_names_of_their_own_whatever_their_folders(tmp_path):
    """a/b.jpg and a_b.jpg become one when folders are joined by underscores."""
    write_colmap(tmp_path, [(32, 24)] * 3)
    path = tmp_path / "sparse" / "0" / "images.txt"
    path.write_text(path.read_text().replace("0000.jpg", "a/b.jpg").replace("0001.jpg", "a_b.jpg"))
    (tmp_path / "images" / "a").mkdir()
    (tmp_path / "images" / "0000.jpg").rename(tmp_path / "images" / "a" / "b.jpg")
    (tmp_path / "images" / "0001.jpg").rename(tmp_path / "images" / "a_b.jpg")
    assert load_dataset(tmp_path).names == ["0000_0002.jpg", "0001_a_b.jpg", "0002_a_b.jpg"]


@pytest.mark.parametrize(("told", "stored"), [("NFC", "NFD"), ("NFD", "NFC")])
def test_letters_with_marks_may_be_composed_or_not(tmp_path, told, stored):
    """macOS takes names apart that other systems write in one."""
    write_colmap(tmp_path, [(32, 24)] * 3)
    path = tmp_path / "sparse" / "0" / "images.txt"
    path.write_text(path.read_text().replace(" 0000", f" {unicodedata.normalize(told, 'Füß')}"), encoding="utf-8")
    (tmp_path / "images" / "0000.jpg").rename(tmp_path / "images" / f"{unicodedata.normalize(stored, 'Füß')}.jpg")
    assert len(load_dataset(tmp_path)) == 3


@pytest.mark.parametrize("suffix", [".webp", ".TIF", ".heic"])
def test_photos_of_a_kind_that_is_not_read_are_named_where_photos_are_missing(tmp_path, suffix):
    write_colmap(tmp_path, [(32, 24)] * 3)
    for photo in (tmp_path / "images").iterdir():
        photo.rename(photo.with_suffix(suffix))
    with pytest.raises(InputError, match=rf"0000{suffix} is there, which is not read: convert it"):
        load_dataset(tmp_path)
