"""Layouts that came with papers: which photo is whose, masks, splits, and frames that have a place in the world."""

import json
import re

import numpy as np
import pytest
import torch
from PIL import Image

from etsplat.core.errors import InputError
from etsplat.data.frames import Wanted
from etsplat.data.load import format_of, load_dataset
from etsplat.data.undistortion import undistort_scene
from etsplat.io.georeference import Georeference
from helpers import foreign_captures as foreign
from helpers.foreign_captures import WRITERS, truth, write_photos


def one_size(count=6):
    """A capture of one camera."""
    capture = truth(count)
    photos = [*capture.photos[:-1], capture.photos[0]]
    return foreign.Truth(
        capture.names,
        [capture.sizes[0]] * count,
        capture.viewmats,
        capture.Ks[:1].expand(count, 3, 3),
        photos,
        capture.points,
        capture.colors,
    )


def named(capture, names):
    return foreign.Truth(
        names, capture.sizes, capture.viewmats, capture.Ks, capture.photos, capture.points, capture.colors
    )


def write_masks(folder, capture, names):
    """The left half of each photo, in three channels."""
    folder.mkdir(parents=True)
    for name, (width, height) in zip(names, capture.sizes, strict=True):
        mask = np.zeros((height, width, 3), np.uint8)
        mask[:, : width // 2] = 255
        Image.fromarray(mask).save(folder / name)


def reprojected(dataset, points):
    """(V, P, 2) pixels."""
    seen = points @ dataset.viewmats[:, :3, :3].mT + dataset.viewmats[:, None, :3, 3]
    pixels = seen @ dataset.Ks.mT
    return pixels[..., :2] / pixels[..., 2:]


@pytest.mark.parametrize("name", ["cameras_sphere.npz", "cameras.npz"])
def test_world_points_of_neus_are_seen_where_its_matrices_put_them(tmp_path, name):
    """Half a pixel from there, as it counts from the first pixel's centre; in single precision, with a factor of -1."""
    capture = truth()
    foreign.write_neus(tmp_path, capture, name=name, scale=231.0, offset=(-28.0, -13.0, 641.0), precision=np.float32)
    found = load_dataset(tmp_path)
    assert found.georeference is not None
    assert found.georeference.scale == pytest.approx(231.0)
    assert found.georeference.offset == pytest.approx((-28.0, -13.0, 641.0))
    pixels = reprojected(found, capture.points)
    world = 231.0 * capture.points.numpy() + np.array([-28.0, -13.0, 641.0])
    with np.load(tmp_path / name) as matrices:
        for view in range(6):
            seen = np.c_[world, np.ones(len(world))] @ matrices[f"world_mat_{view}"].astype(float)[:3].T
            np.testing.assert_allclose(pixels[view], seen[:, :2] / seen[:, 2:] + 0.5, atol=1e-2)
    torch.testing.assert_close(found.viewmats, capture.viewmats, atol=2e-5, rtol=0)


def test_a_turned_sphere_of_neus_has_its_cameras_but_no_way_back(tmp_path):
    """A georeference cannot turn."""
    capture = truth()
    foreign.write_neus(tmp_path, capture)
    turn = np.eye(4)
    turn[:2, :2] = [[0.6, -0.8], [0.8, 0.6]]
    with np.load(tmp_path / "cameras_sphere.npz") as file:
        matrices = dict(file)
    changed = {key: matrices[key] @ turn for key in matrices if key.startswith("scale_mat") and "inv" not in key}
    np.savez(tmp_path / "cameras_sphere.npz", **{**matrices, **changed})
    found = load_dataset(tmp_path)
    assert found.georeference is None
    torch.testing.assert_close(found.viewmats, capture.viewmats @ torch.from_numpy(turn))


def test_neus_masks_are_taken_by_their_order(tmp_path):
    """DTU calls them otherwise than their photos; and a note that mask/ is not read would be wrong."""
    capture = truth()
    foreign.write_neus(tmp_path, capture)
    write_masks(tmp_path / "mask", capture, [f"{index:03d}.png" for index in range(6)])
    found = load_dataset(tmp_path, masks_as="alpha")
    assert found.notes == ()
    assert found.images[5].shape == (48, 36, 4)
    assert found.images[5][:, :18, 3].min() == 1
    assert found.images[5][:, 18:, 3].max() == 0
    (tmp_path / "mask" / "003.png").unlink()
    with pytest.raises(InputError, match=r"has 6 poses, but there are 5 masks"):
        load_dataset(tmp_path)
    write_masks(tmp_path / "masks", capture, [f"{name}.png" for name in capture.names])
    assert load_dataset(tmp_path).images.mask(3) is not None


@pytest.mark.parametrize("kind", ["neus", "llff", "opensfm", "nsvf", "nerf_plus_plus", "mvsnet"])
def test_undistort_keeps_cameras_masks_and_split(tmp_path, kind):
    pytest.importorskip("pycolmap")
    capture = named(one_size(4), ["0_a", "0_b", "0_c", "2_a"])
    WRITERS[kind](tmp_path / "scene", capture)
    write_masks(tmp_path / "scene" / "masks", capture, [f"{name}.png" for name in capture.names])
    before = load_dataset(tmp_path / "scene")
    undistort_scene(tmp_path / "scene", tmp_path / "new")
    after = load_dataset(tmp_path / "new")
    torch.testing.assert_close(after.viewmats, before.viewmats, atol=1e-6, rtol=0)
    torch.testing.assert_close(after.Ks, before.Ks, atol=1e-6, rtol=0)
    tested = {name.removeprefix("test_rgb_") for name in after.names if after.names.index(name) in after.test}
    assert tested == {before.names[view].removeprefix("test_") for view in before.test}
    assert after.images.mask(0) is not None


def test_the_way_back_to_neus_world_is_kept_by_undistort(tmp_path):
    pytest.importorskip("pycolmap")
    foreign.write_neus(tmp_path / "scene", one_size(3), scale=2.0, offset=(3.0, -1.0, 0.5))
    undistort_scene(tmp_path / "scene", tmp_path / "new")
    assert load_dataset(tmp_path / "new").georeference == Georeference((3.0, -1.0, 0.5), 2.0)


def test_a_file_georeference_json_overrules_what_a_layout_says(tmp_path):
    foreign.write_opensfm(tmp_path, truth(), lla=True)
    own = load_dataset(tmp_path).georeference
    assert own is not None
    assert own.up == "z"
    assert own.crs == "east, north and up in metres from latitude 46.5, longitude 6.25, altitude 400 (WGS 84)"
    Georeference((1.0, 2.0, 3.0)).write(tmp_path)
    assert load_dataset(tmp_path).georeference == Georeference((1.0, 2.0, 3.0))


def test_llffs_copies_have_the_cameras_of_its_photos(tmp_path):
    """By their order, whatever they are called; masks have the names of the photos. Without photos copies are taken."""
    capture = truth(centered=True)
    foreign.write_llff(tmp_path, capture)
    for index, (photo, (width, height)) in enumerate(zip(capture.photos, capture.sizes, strict=True)):
        (tmp_path / "images_2").mkdir(exist_ok=True)
        small = Image.fromarray(photo).resize((width // 2, height // 2))
        small.save(tmp_path / "images_2" / f"image{index:03d}.png")
    write_masks(tmp_path / "masks", capture, [f"{name}.png" for name in capture.names])
    found = load_dataset(tmp_path, images="images_2")
    assert found.names == list(capture.names)
    assert found.images.mask(0) is not None
    torch.testing.assert_close(found.Ks[:, :2], capture.Ks[:, :2] / 2)
    for path in (tmp_path / "images").iterdir():
        path.unlink()
    (tmp_path / "images").rmdir()
    frames = format_of(tmp_path).list_frames(tmp_path, Wanted(masks=tmp_path / "images_2")).frames
    assert [frame.image.parent.name for frame in frames] == ["images_2"] * 6


PARTS = {
    "train and test": (["0_a", "0_b", "0_c", "0_d", "2_a", "2_b"], 4, 2, ()),
    "train and validation": (["0_a", "0_b", "0_c", "0_d", "1_a", "1_b"], 4, 2, ()),
    "all": (
        ["0_a", "0_b", "0_c", "1_a", "2_a", "2_b"],
        3,
        2,
        ("1 of 6 photos are for validation and are left out",),
    ),
    "none": (["0_a", "a", "b", "c", "d", "e"], 5, 1, ()),
}


@pytest.mark.parametrize("case", PARTS)
def test_nsvfs_names_say_what_is_for_testing(tmp_path, case):
    names, train, test, notes = PARTS[case]
    foreign.write_nsvf(tmp_path, named(one_size(), names))
    found = load_dataset(tmp_path)
    assert (len(found.train), len(found.test)) == (train, test)
    assert found.notes == notes
    if case != "none":
        assert {found.names[view][0] for view in found.train} == {"0"}


@pytest.mark.parametrize(
    "intrinsics",
    [
        "52.5 25.25 17.25 0.\n0. 0. 0.\n0.1\n1.\n36 48\n",
        "52.5 0 25.25\n0 52.5 17.25\n0 0 1\n",
        "105 0 50.5 0\n0 105 34.5 0\n0 0 2 0\n0 0 0 1\n",
    ],
)
def test_nsvfs_intrinsics_are_a_line_or_a_matrix(tmp_path, intrinsics):
    capture = one_size()
    foreign.write_nsvf(tmp_path, capture, intrinsics=intrinsics)
    torch.testing.assert_close(load_dataset(tmp_path).Ks, capture.Ks)


def test_nerf_plus_plus_tests_what_is_in_test(tmp_path):
    """Or in validation, where there is no test; masks are those beside the photos."""
    capture = truth()
    foreign.write_nerf_plus_plus(tmp_path / "a", capture, tests=2)
    found = load_dataset(tmp_path / "a")
    assert [found.names[view] for view in found.test] == ["test_photo_000", "test_photo_001"]
    foreign.write_nerf_plus_plus(tmp_path / "b", capture, tested="validation")
    write_masks(tmp_path / "b" / "train" / "mask", capture, [f"{name}.png" for name in capture.names])
    found = load_dataset(tmp_path / "b")
    assert [found.names[view] for view in found.test] == ["validation_photo_000"]
    assert all((found.images.mask(view) is not None) == (view in found.train) for view in range(6))
    foreign.write_nerf_plus_plus(tmp_path / "b", capture)
    (tmp_path / "b" / "train" / "pose" / "photo_000.txt").unlink(missing_ok=True)
    found = load_dataset(tmp_path / "b")
    assert [found.names[view] for view in found.test] == ["test_photo_000"]
    assert "1 of 7 photos are for validation and are left out" in found.notes


def test_blended_mvs_photos_are_read_without_their_masked_copies(tmp_path):
    capture = truth()
    foreign.write_mvsnet(tmp_path, capture, photos="blended_images")
    write_photos(tmp_path / "blended_images", capture, [f"{name}_masked.png" for name in capture.names])
    found = load_dataset(tmp_path)
    assert found.names == list(capture.names)
    assert found.notes == ()


def test_photos_without_a_pose_are_noted(tmp_path):
    foreign.write_mvsnet(tmp_path / "a", truth())
    (tmp_path / "a" / "cams" / "photo_002_cam.txt").unlink()
    assert load_dataset(tmp_path / "a").notes == ("1 of 6 photos have no pose and are left out",)
    foreign.write_opensfm(tmp_path / "b", truth(), place="opensfm/reconstruction.json")
    write_photos(tmp_path / "b" / "images", truth(1), ["another.png"])
    assert load_dataset(tmp_path / "b").notes == ("1 of 7 photos have no pose and are left out",)


def edited(path, old, new, count=1):
    text = path.read_text()
    changed = re.sub(old, new, text, count=count)
    assert changed != text
    path.write_text(changed)


def neus(change, **settings):
    """With changed matrices; None takes one away."""

    def make(folder):
        foreign.write_neus(folder, truth(), **settings)
        with np.load(folder / "cameras_sphere.npz") as file:
            matrices = {**dict(file), **{key: edit(dict(file)) for key, edit in change.items()}}
        kept = {key: value for key, value in matrices.items() if value is not None}
        np.savez(folder / "cameras_sphere.npz", **kept)

    return make


def llff(change):
    def make(folder):
        foreign.write_llff(folder, truth(centered=True))
        np.save(folder / "poses_bounds.npy", change(np.load(folder / "poses_bounds.npy")))

    return make


def text(write, name, old, new):
    def make(folder):
        write(folder)
        edited(folder / name, old, new)

    return make


def opensfm(old, new, **settings):
    return text(lambda folder: foreign.write_opensfm(folder, truth(), **settings), "reconstruction.json", old, new)


def nsvf(name, old, new):
    return text(lambda folder: foreign.write_nsvf(folder, one_size()), name, old, new)


def mvsnet(old, new):
    return text(lambda folder: foreign.write_mvsnet(folder, truth()), "cams/photo_002_cam.txt", old, new)


def plus_plus(name, old, new):
    return text(lambda folder: foreign.write_nerf_plus_plus(folder, truth()), name, old, new)


def bytes_instead(folder):
    foreign.write_neus(folder, truth())
    (folder / "cameras_sphere.npz").write_bytes(b"PK\3\4 no more")


def objects_instead(folder):
    foreign.write_neus(folder, truth())
    np.savez(folder / "cameras_sphere.npz", world_mat_0=np.array([{}], object), scale_mat_0=np.eye(4))


def without_photos(folder):
    foreign.write_neus(folder, truth())
    (folder / "image").rename(folder / "pictures")


def without_intrinsics(folder):
    foreign.write_nerf_plus_plus(folder, truth())
    (folder / "train" / "intrinsics" / "photo_002.txt").unlink()


def squashed(file):
    return file["scale_mat_0"] @ np.diag([1, 1, 0.5, 1])


def skewed(file):
    shear = np.eye(4)
    shear[0, 1] = 0.1
    return shear @ file["world_mat_2"]


def with_nan(file):
    return np.where(np.eye(4) > 0, np.nan, file["world_mat_2"])


def mirrored(rows):
    rows = rows.copy()
    rows[2, [1, 6, 11]] *= -1
    return rows


REFUSED = {
    "neus damaged": (bytes_instead, "cameras_sphere.npz: damaged, or no NPZ file"),
    "neus objects": (objects_instead, "world_mat_0 holds no small array of numbers"),
    "neus photos": (without_photos, "no folder image or rgb or images beside it"),
    "neus gap": (neus({"world_mat_0": lambda file: None}), "has no world_mat_0; it must have"),
    "neus scale": (neus({"scale_mat_3": lambda file: None}), "has no scale_mat_3; it must have"),
    "neus middle": (neus({"world_mat_4": lambda file: None}), "has no world_mat_4; it must have"),
    "neus fewer": (neus({"world_mat_5": lambda file: None}), "has 5 poses, but there are 6 photos"),
    "neus squashed": (neus({f"scale_mat_{k}": squashed for k in range(6)}), "does not scale all directions alike"),
    "neus frames": (neus({"scale_mat_3": lambda file: 2 * file["scale_mat_3"]}), "camera 3 has another scale_mat"),
    "neus skew": (neus({"world_mat_2": skewed}), "camera 2 has skew"),
    "neus flat": (neus({"world_mat_2": lambda file: np.zeros((4, 4))}), "camera 2 has a matrix that projects onto no"),
    "neus nan": (neus({"world_mat_2": with_nan}), "camera 2 has no world_mat of 16 finite numbers"),
    "llff columns": (llff(lambda rows: rows[:, :15]), r"has the shape \(6, 15\)"),
    "llff fewer": (llff(lambda rows: rows[:5]), "has 5 poses, but there are 6 photos"),
    "llff nan": (llff(lambda rows: np.where(rows == rows[1, 0], np.nan, rows)), r"pose 1 \(photo_001.png\) has no"),
    "llff mirrored": (llff(mirrored), r"pose 2 \(photo_002.png\) has a pose that scales or mirrors"),
    "llff objects": (llff(lambda rows: np.array([None] * 6, object)), "damaged, or no NPY file of numbers"),
    "opensfm type": (opensfm('"brown"', '"dual"'), "camera 'v2 someone 0' is of type dual, which is not read"),
    "opensfm k6": (opensfm('"brown"', '"brown", "k6": 0.1'), "of type brown has k6, which is not read"),
    "opensfm camera": (opensfm('"v2 someone 0"', '"v2 another"'), r"shot 'photo_000.png' uses a camera that is not"),
    "opensfm rotation": (opensfm(r'"rotation": \[[^,]*', '"rotation": [NaN'), "has no rotation of 3 finite numbers"),
    "opensfm nothing": (opensfm(r"(?s).+", "[]"), "is no list of reconstructions"),
    "opensfm shots": (opensfm('"shots": {', '"shots": [], "others": {'), "`shots` of a reconstruction is no"),
    "nsvf pose": (nsvf("pose/photo_002.txt", r"^\S+", "wide"), "the camera has no pose of 16 finite numbers"),
    "nsvf transposed": (nsvf("pose/photo_002.txt", r"0.0 0.0 0.0 1.0\n$", "1 2 3 1"), "last row is not 0 0 0 1"),
    "nsvf scaled": (nsvf("pose/photo_002.txt", r"^\S+", "2.0"), "scales or mirrors"),
    "nsvf intrinsics": (nsvf("intrinsics.txt", r"(?s).+", "wide\n"), "the camera has no first line of 3 finite"),
    "nsvf empty": (nsvf("intrinsics.txt", r"(?s).+", "\n"), "the camera has no first line of 3 finite"),
    "nsvf order": (nsvf("intrinsics.txt", r"(?s).+", "48 0 1\n0 0 52\n0 1 0\n"), "has intrinsics that are no camera's"),
    "nerf++ intrinsics": (without_intrinsics, "photo_002.txt: cannot be read"),
    "nerf++ numbers": (plus_plus("train/pose/photo_002.txt", r"\S+ $", ""), "has no pose of 16 finite numbers"),
    "mvsnet words": (mvsnet("intrinsic\n(?=5)", "K\n"), "does not say `extrinsic` and then `intrinsic`"),
    "mvsnet numbers": (mvsnet("extrinsic\n", "extrinsic\n1 "), "has no extrinsic of 16 finite numbers"),
    "mvsnet skew": (mvsnet("\n52.5 0.0", "\n52.5 9.0"), "has skew"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_used_is_named_in_one_line(tmp_path, case):
    make, message = REFUSED[case]
    make(tmp_path)
    foreign.check_refused(tmp_path, message)


def test_the_largest_of_opensfms_reconstructions_is_read(tmp_path):
    foreign.write_opensfm(tmp_path, truth())
    path = tmp_path / "reconstruction.json"
    (whole,) = json.loads(path.read_text())
    few = {**whole, "shots": dict(list(whole["shots"].items())[:2])}
    path.write_text(json.dumps([few, whole]))
    found = load_dataset(tmp_path)
    assert len(found) == 6
    assert found.notes == ("2 reconstructions: that with the most photos, 6, is read, and no other",)
