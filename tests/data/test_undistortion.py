"""Scenes with lens distortion become scenes without, or are refused."""

import math

import numpy as np
import pytest
import torch
from PIL import Image

from etsplat.core.errors import InputError
from etsplat.data.load import load_dataset
from etsplat.data.undistortion import undistort_scene
from helpers.captures import circle_poses, write_colmap, write_photo, write_transforms
from helpers.photos import write_phone_photo


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
