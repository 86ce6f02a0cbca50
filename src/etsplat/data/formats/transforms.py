"""Scenes described by `transforms*.json`: the Blender (NeRF-synthetic) and nerfstudio layouts.

Both give camera-to-world matrices with OpenGL axes (x right, y up, the camera looks along -z); flipping y and z and
inverting gives our world-to-camera matrices with OpenCV axes.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset
from etsplat.data.frames import Frame, Wanted, check_frames, find_image, find_mask, posed
from etsplat.io.images import image_size
from etsplat.io.paths import path_within
from etsplat.io.ply_tables import load_points

MARK = "transforms.json"
RANK = 1

Points = tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]
"""float64 positions, float32 colours."""

_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_PERSPECTIVE, _FISHEYE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE"), ("OPENCV_FISHEYE", "FISHEYE")
_UNDISTORT = "run `etsplat data undistort SCENE --out NEW` and use the new folder"


@dataclass(frozen=True)
class Lens:
    """Distortion as COLMAP has it: the model, and its parameters after fx, fy, cx, cy."""

    model: str
    coefficients: tuple[float, ...]


@dataclass(frozen=True)
class DistortedFrames:
    """Frames of `transforms.json` before their distortion is removed.

    Attributes:
        scene: where they are described.
        frames: with their poses.
        points: of the scene, or None.
        lenses: of each frame.
        folder: of all images.
        names: of each frame's image in it.
        masks: the masks by these names; empty without.
    """

    scene: Path
    frames: list[Frame]
    points: Points | None
    lenses: list[Lens]
    folder: Path
    names: list[str]
    masks: dict[str, Path]


def recognises(folder: Path) -> bool:
    """Whether one of the files is there."""
    return any((folder / name).is_file() for name in ("transforms.json", "transforms_train.json"))


def read(folder: Path, wanted: Wanted) -> Dataset:
    """Read a scene folder with `transforms.json`, or with `transforms_train.json` and `transforms_test.json`.

    Masks come from each frame's `mask_path`, or from a folder `masks/` with a file for every image; RGBA images need
    none. With one `transforms.json` its `train_filenames` and `test_filenames` make the split; without them, every 8th
    image by name is test. `transforms_val.json` is not used. `ply_file_path` names the points.

    Args:
        folder: the scene.
        wanted: other masks; other images, in a folder that replaces the first of each image's path (`images_4`).

    Returns:
        Views in the scene's own units.

    Raises:
        InputError: a file is missing, damaged or of another layout; cameras with lens distortion; as `posed`.
    """
    path = folder / "transforms.json"
    if path.is_file():
        frames = sorted(_frames(path, wanted), key=lambda frame: frame.name)
        return posed(folder, frames, wanted, split=_named_split(path, frames), points=_points(path))
    path, test_file = folder / "transforms_train.json", folder / "transforms_test.json"
    frames = _frames(path, wanted)
    if not test_file.is_file():
        return posed(folder, frames, wanted, points=_points(path))
    count = len(frames)
    frames += _frames(test_file, wanted)
    split = list(range(count)), list(range(count, len(frames)))
    return posed(folder, frames, wanted, split=split, points=_points(path))


def read_distorted_transforms(folder: Path) -> DistortedFrames:
    """What `transforms.json` says of images with lens distortion (k1 to k4, p1, p2, OPENCV_FISHEYE).

    Raises:
        InputError: as `read`; a lens that COLMAP does not know.
    """
    path = folder / "transforms.json"
    document = _read(path)
    frames = sorted(_frames(path, Wanted(), distorted=True), key=lambda frame: frame.name)
    entries = {_plain(entry["file_path"]): {**document, **entry} for entry in document["frames"]}
    lenses = [_lens(path, frame.name, entries[frame.name]) for frame in frames]
    check_frames(folder, frames)
    points = _points(path)
    outside = [frame for frame in frames if not frame.image.is_relative_to(folder)]
    if outside:
        raise InputError(f"scene {path}: {outside[0].name} lies outside of the scene's folder; copy the images into it")
    files = [frame.image.relative_to(folder) for frame in frames]
    first = files[0].parts[0]
    together = all(len(file.parts) > 1 and file.parts[0] == first for file in files)
    images = folder / first if together else folder
    names = [frame.image.relative_to(images).as_posix() for frame in frames]
    masks = {name: frame.mask for name, frame in zip(names, frames, strict=True) if frame.mask is not None}
    return DistortedFrames(folder, frames, points, lenses, images, names, masks)


def _named_split(path: Path, frames: list[Frame]) -> tuple[list[int], list[int]] | None:
    """As the file says; None where it does not."""
    document = _read(path)
    if "train_filenames" not in document or "test_filenames" not in document:
        return None
    train_names, test_names = _name_set(path, document, "train_filenames"), _name_set(path, document, "test_filenames")
    train = [index for index, frame in enumerate(frames) if frame.name in train_names]
    test = [index for index, frame in enumerate(frames) if frame.name in test_names - train_names]
    if not train:
        raise InputError(f"scene {path}: train_filenames names none of the frames; correct or remove it")
    return train, test


def _points(path: Path) -> Points | None:
    """The points of `ply_file_path`, in the frame of the poses."""
    name = _read(path).get("ply_file_path")
    if name is None:
        return None
    if not isinstance(name, str):
        raise InputError(f"scene {path}: ply_file_path = {name!r} is not a file name; correct or remove it")
    points, colors = load_points(path_within(path.parent, _plain(name), path))
    return (points, colors) if len(points) else None


def _name_set(path: Path, document: dict[str, Any], key: str) -> set[str]:
    names = document[key]
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(f"scene {path}: {key} is not a list of file names; correct or remove it")
    return {_plain(name) for name in names}


def _plain(name: str) -> str:
    """A path as frames are named: forward slashes, nothing before the first folder."""
    return name.replace("\\", "/").removeprefix("./")


def _frames(path: Path, wanted: Wanted, *, distorted: bool = False) -> list[Frame]:
    document = _read(path)
    entries = document.get("frames")
    if not isinstance(entries, list) or not entries:
        raise InputError(f"scene {path}: no list `frames`; is it a NeRF capture? Export the poses again")
    return [_frame(path, document, entry, wanted, distorted) for entry in entries]


def _frame(path: Path, document: dict[str, Any], entry: dict[str, Any], wanted: Wanted, distorted: bool) -> Frame:
    if not isinstance(entry, dict) or not isinstance(entry.get("file_path"), str):
        raise InputError(f"scene {path}: a frame without `file_path`; export the poses again")
    name = _plain(entry["file_path"])
    if wanted.images is None:
        image = find_image(path.parent, name, path)
    else:  # it replaces the first folder
        image = find_image(path.parent / wanted.images, name.split("/", 1)[-1], path)
    settings = {**document, **entry}
    if not distorted:
        _refuse_distortion(path, name, settings)
    size = _size(path, name, settings, image)
    mask = None
    if wanted.masks is not None:
        mask = find_mask(wanted.masks, image.name, path)
    elif isinstance(entry.get("mask_path"), str):
        mask = path_within(path.parent, _plain(entry["mask_path"]), path)
    elif (path.parent / "masks").is_dir():
        mask = find_mask(path.parent / "masks", image.name, path)
    return Frame(name, image, mask, _viewmat(path, name, entry), _intrinsics(path, name, settings, size), size)


def _read(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise InputError(
            f"scene {path}: not valid JSON ({str(error).splitlines()[0]}); export the poses again"
        ) from error
    if not isinstance(document, dict):
        raise InputError(f"scene {path}: expected a JSON object with a list `frames`; export the poses again")
    return document


def _refuse_distortion(path: Path, name: str, settings: dict[str, Any]) -> None:
    model = settings.get("camera_model", "OPENCV")
    if model not in _PERSPECTIVE or settings.get("is_fisheye"):
        raise InputError(f"scene {path}: {name} has a {model} camera; {_UNDISTORT}")
    distorted = [key for key in _DISTORTION if _number(path, name, settings, key, 0.0) != 0]
    if distorted:
        raise InputError(f"scene {path}: {name} has lens distortion ({', '.join(distorted)}); {_UNDISTORT}")


def _lens(path: Path, name: str, settings: dict[str, Any]) -> Lens:
    model = settings.get("camera_model", "OPENCV")
    k1, k2, k3, k4, k5, k6, p1, p2 = (_number(path, name, settings, key, 0.0) for key in _DISTORTION)
    if settings.get("is_fisheye") or model in _FISHEYE:  # the former is instant-ngp's
        if p1 == p2 == k5 == k6 == 0:
            return Lens("OPENCV_FISHEYE", (k1, k2, k3, k4))
    elif model in _PERSPECTIVE and k4 == k5 == k6 == 0:  # of k4 on, programs disagree what it means
        short = (k1, k2, p1, p2)
        return Lens("OPENCV", short) if k3 == 0 else Lens("FULL_OPENCV", (*short, k3, 0.0, 0.0, 0.0))
    raise InputError(
        f"scene {path}: {name} has a {model} camera with coefficients that are not known here; undistort its images"
        " with the program that made them"
    )


def _size(path: Path, name: str, settings: dict[str, Any], image: Path) -> tuple[int, int]:
    if "w" in settings and "h" in settings:
        size = int(_number(path, name, settings, "w", 0)), int(_number(path, name, settings, "h", 0))
        if min(size) < 1:
            raise InputError(f"scene {path}: {name} has the size {size[0]}x{size[1]}; correct w and h")
        return size
    # A missing image is reported later, together with all others.
    return image_size(image) if image.is_file() else (1, 1)


def _intrinsics(path: Path, name: str, settings: dict[str, Any], size: tuple[int, int]) -> Float[Tensor, "3 3"]:
    def focal(key: str, angle_key: str, extent: int, default: float | None) -> float | None:
        if key in settings:
            return _number(path, name, settings, key, 0.0)
        if angle_key in settings:
            return 0.5 * extent / math.tan(0.5 * _number(path, name, settings, angle_key, 0.0))
        return default

    fx = focal("fl_x", "camera_angle_x", size[0], None)
    if fx is None:
        raise InputError(f"scene {path}: {name} has neither fl_x nor camera_angle_x; export the poses again")
    fy = focal("fl_y", "camera_angle_y", size[1], fx)
    cx = _number(path, name, settings, "cx", size[0] / 2)
    cy = _number(path, name, settings, "cy", size[1] / 2)
    if fy is None or min(fx, fy) <= 0 or not all(math.isfinite(value) for value in (fx, fy, cx, cy)):
        raise InputError(f"scene {path}: {name} has a focal length that is not positive; export the poses again")
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)


def _viewmat(path: Path, name: str, entry: dict[str, Any]) -> Float[Tensor, "4 4"]:
    try:
        matrix = torch.tensor(entry.get("transform_matrix"), dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError):
        matrix = torch.empty(0)
    if tuple(matrix.shape) not in ((4, 4), (3, 4)) or not bool(torch.isfinite(matrix).all()):
        raise InputError(f"scene {path}: {name} has no 4x4 transform_matrix of finite numbers; export the poses again")
    camera_to_world = torch.eye(4, dtype=torch.float64)
    camera_to_world[:3] = matrix[:3]
    rotation = camera_to_world[:3, :3]
    if not torch.allclose(rotation.T @ rotation, torch.eye(3, dtype=torch.float64), atol=1e-3) or rotation.det() < 0:
        raise InputError(f"scene {path}: the transform_matrix of {name} scales or mirrors; export rigid poses")
    return torch.linalg.inv(camera_to_world * torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))


def _number(path: Path, name: str, settings: dict[str, Any], key: str, default: float) -> float:
    value = settings.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"scene {path}: {name} has {key} = {value!r}, which is not a number; export the poses again")
    return float(value)
