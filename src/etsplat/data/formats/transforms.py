"""Scenes described by `transforms*.json`: the Blender (NeRF-synthetic) and nerfstudio layouts.

Both give camera-to-world matrices with OpenGL axes (x right, y up, the camera looks along -z); flipping y and z and
inverting gives our world-to-camera matrices with OpenCV axes.
"""

import math
from pathlib import Path, PurePosixPath
from typing import Any

from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.data.frames import LARGEST, Frame, Lens, Listing, Points, Wanted, find_image, pinhole
from etsplat.data.matrix_cameras import checked_intrinsics
from etsplat.data.scene_files import (
    OPENGL,
    Entry,
    brown_lens,
    name_below,
    placed_file,
    placed_image,
    read_object,
    size_of,
    unplaced_note,
)
from etsplat.io.images import size_for
from etsplat.io.ply_tables import load_points

MARK = "transforms.json"
RANK = 1

_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL")
_FISHEYE = ("OPENCV_FISHEYE", "FISHEYE")
_PIXELS = {"fl_x", "fl_y", "cx", "cy", "K"}
"""In pixels of an image of `w` x `h`."""


def recognises(folder: Path) -> bool:
    """Whether one of the files is there."""
    return any((folder / name).is_file() for name in ("transforms.json", "transforms_train.json"))


def list_frames(folder: Path, wanted: Wanted) -> Listing:
    """The frames of a folder with `transforms.json`, or with `transforms_train.json` and `transforms_test.json`.

    Masks come from each frame's `mask_path`, or from a folder `masks/` with a file for every image; RGBA images need
    none. Depth maps, where they are wanted, come from each frame's `depth_file_path`, in steps of
    `depth_unit_scale_factor` if that is there, or from a folder `depths/` or `depth/`. With one `transforms.json` its
    `train_filenames` and `test_filenames` make the split, or its `val_filenames` where nothing is for testing; without
    the first, all others are for training. Photos in both are trained on, which a note says. Without them, every 8th
    image by name is test. `transforms_val.json` is used where there is no other for testing. `ply_file_path` names the
    points.

    Args:
        folder: the scene.
        wanted: other masks; other images, in a folder that replaces the first of each image's path (`images_4`).

    Raises:
        InputError: a file is missing, damaged or of another layout.
    """
    path, split, notes = folder / "transforms.json", None, ()
    if path.is_file():
        document = read_object(path)
        frames = _frames(path, document, wanted)
        lying = _lying_note(path, document, frames)
        frames.sort(key=lambda frame: frame.name)
        named = _named_split(path, document, frames)
        if named is not None:
            split, twice = named[:2], named[2]
            neither = len(frames) - len(split[0]) - len(split[1])
            notes = unplaced_note(neither, len(frames), "are named neither for training nor for testing")
            if twice:
                notes += (f"{twice} photos are named for training and for testing: they are trained on, not tested",)
        elif document.get("train_filenames"):
            notes = ("train_filenames is without test_filenames: every 8th of all photos is tested",)
    else:
        path = folder / "transforms_train.json"
        others = (folder / f"transforms_{name}.json" for name in ("test", "val"))
        document = read_object(path)
        frames = _frames(path, document, wanted)
        lying = _lying_note(path, document, frames)
        if (test_file := next((other for other in others if other.is_file()), None)) is not None:
            count = len(frames)
            frames += _frames(test_file, read_object(test_file), wanted)
            split = list(range(count)), list(range(count, len(frames)))
    return Listing(frames, split, _points(path, document), (*notes, *lying))


def _named_split(path: Path, document: dict[str, Any], frames: list[Frame]) -> tuple[list[int], list[int], int] | None:
    """(train, test) as the file says, and how many photos it names for both; None where it names none for testing."""
    train_names, test_names, val_names = (
        _named(path, document, key, frames) for key in ("train_filenames", "test_filenames", "val_filenames")
    )
    tested = test_names or val_names
    if not tested and (test_names is None or train_names is None):
        return None
    tested = tested or set()
    if train_names is None:  # whatever is not for testing
        train_names = {frame.name for frame in frames} - tested
    train = [index for index, frame in enumerate(frames) if frame.name in train_names]
    test = [index for index, frame in enumerate(frames) if frame.name in tested - train_names]
    if not train:
        raise InputError(f"scene {path}: no frame is left for training; correct train_filenames or remove it")
    return train, test, len(train_names & tested)


def _named(path: Path, document: dict[str, Any], key: str, frames: list[Frame]) -> set[str] | None:
    """Names of the frames that an entry lists; None without it. Raises InputError where it lists none that there is."""
    said = document.get(key)
    if said is None:
        return None
    if not isinstance(said, list) or not all(isinstance(name, str) for name in said):
        raise InputError(f"scene {path}: {key} is not a list of file names; correct or remove it")
    names = {_image(path, name)[0] for name in said}
    if names and names.isdisjoint(frame.name for frame in frames):
        raise InputError(f"scene {path}: {key} names none of the frames; correct or remove it")
    return names


def _lying_note(path: Path, document: dict[str, Any], frames: list[Frame]) -> tuple[str, ...]:
    """That photos are taken as they are stored, where they lie on their side and nothing says which way poses mean."""
    count = 0
    for own, frame in zip(document["frames"], frames, strict=True):
        entry = _entry(path, frame.name, document, own)
        if not {"w", "h"} & entry.said.keys() and _shape(entry) is None and frame.image.is_file():
            width, height = frame.size
            count += size_for(frame.image, (height, width)) != frame.size
    if not count:
        return ()
    return (
        f"{count} of {len(frames)} photos lie on their side, as their EXIF says, and are taken as they are stored:"
        f" where poses mean them upright, write w and h of the upright photos into {path.name}",
    )


def _points(path: Path, document: dict[str, Any]) -> Points | None:
    """The points of `ply_file_path`, in the frame of the poses."""
    name = document.get("ply_file_path")
    if name is None:
        return None
    if not isinstance(name, str):
        raise InputError(f"scene {path}: ply_file_path = {name!r:.40} is not a file name; correct or remove it")
    points = load_points(placed_file([path.parent], name, path)[1])
    return points if len(points[0]) else None


def _image(path: Path, said: str) -> tuple[str, Path]:
    """Name and file of an image; names lead from the folder itself, or from its `images`."""
    name, image = placed_file([path.parent, path.parent / "images"], said, path, find_image)
    if not image.is_file():
        _refuse_outside(path, said)
    return name, image


def _refuse_outside(path: Path, said: str) -> None:
    """Raises InputError where a name that begins with `..` leads to an image: it would be called missing."""
    parts = PurePosixPath(said.replace("\\", "/")).parts
    up = next((count for count, part in enumerate(parts) if part != ".."), 0)
    above = path.absolute().parents
    if 0 < up < len(above) and find_image(above[up], "/".join(parts[up:]), path).is_file():
        raise InputError(
            f"scene {path}: names {said[:80]!r}, which is outside of its folder, where nothing is looked for; move"
            f" {path.name} to {above[up]}, where it is read as it is, and name that folder"
        )


def _frames(path: Path, document: dict[str, Any], wanted: Wanted) -> list[Frame]:
    entries = document.get("frames")
    if not isinstance(entries, list) or not entries:
        raise InputError(f"scene {path}: no list `frames`; is it a NeRF capture? Export the poses again")
    return [_frame(path, document, entry, wanted) for entry in entries]


def _frame(path: Path, document: dict[str, Any], own: Any, wanted: Wanted) -> Frame:
    if not isinstance(own, dict) or not isinstance(own.get("file_path"), str):
        raise InputError(f"scene {path}: a frame without `file_path`; export the poses again")
    name, image = _image(path, own["file_path"])
    entry = _entry(path, name, document, own)
    whole = image
    if wanted.images is not None:
        image = placed_image(path.parent, own["file_path"], path, wanted)[1]
    if wanted.masks is None and isinstance(own.get("mask_path"), str):
        mask = placed_file([path.parent], own["mask_path"], path, least=2)[1]
    else:
        mask = wanted.mask_of(path.parent, name_below(image, path.parent), path)
    size = _size(entry, image, whole)
    depth, unit = _depth(entry, image, wanted)
    return Frame(entry.name, image, mask, _viewmat(entry), _intrinsics(entry, size), size, _lens(entry), depth, unit)


def _entry(path: Path, name: str, document: dict[str, Any], own: dict[str, Any]) -> Entry:
    """What is said of a frame, by it or of all; null says nothing."""
    said = [(key, value) for source in (document, own) for key, value in source.items() if value is not None]
    return Entry(path, name, dict(said))


def _depth(entry: Entry, image: Path, wanted: Wanted) -> tuple[Path | None, float | None]:
    """The depth map of a frame, and its unit: as somebody says, or the file."""
    unit = wanted.depth_unit
    if unit is None and wanted.depths is not False and "depth_unit_scale_factor" in entry.said:
        unit = entry.number("depth_unit_scale_factor")
        if not 0 < unit <= LARGEST:
            raise entry.wrong(f"has depth_unit_scale_factor = {unit:g}; write a positive number")
    named = entry.said.get("depth_file_path")
    if wanted.depths is True and isinstance(named, str):
        path = placed_file([entry.path.parent], named, entry.path, least=2)[1]
        if not path.is_file():
            raise entry.wrong(f"has the depth map {path}, which is not there; copy it there or remove depth_file_path")
        return path, unit
    return wanted.depth_of(entry.path.parent, name_below(image, entry.path.parent), entry.path), unit


def _lens(entry: Entry) -> Lens | None:
    """None without distortion."""
    model = str(entry.said.get("camera_model", "OPENCV")).upper()
    values = {key: entry.number(key, 0.0) for key in _DISTORTION}
    k1, k2, k3, k4, k5, k6, p1, p2 = values.values()
    fisheye = entry.said.get("is_fisheye") or model in _FISHEYE  # the former is instant-ngp's
    if not fisheye and model not in _PERSPECTIVE:
        raise entry.wrong(f"has a {model:.40} camera, which is not read; export perspective or fisheye images")
    if fisheye:
        if p1 == p2 == k5 == k6 == 0:
            return Lens("OPENCV_FISHEYE", (k1, k2, k3, k4), f"a {model} camera")
    elif k4 == k5 == k6 == 0:  # of k4 on, programs disagree what it means
        told = f"lens distortion ({', '.join(key for key, value in values.items() if value != 0)})"
        return brown_lens(told, k1, k2, k3, p1, p2)
    raise entry.wrong(
        f"has a {model:.40} camera with coefficients that are not known here; undistort its images with the program"
        " that made them"
    )


def _size(entry: Entry, image: Path, whole: Path) -> tuple[int, int]:
    """That of the intrinsics: as the file says, one side by the other and the photo's shape, or else the photo's.

    The latter upright, where only then it is wide or high as they are.

    Args:
        entry: of the frame.
        image: that is used.
        whole: that the file names, of which `image` may be a smaller copy.
    """
    said = {key: entry.number(key) for key in ("w", "h") if key in entry.said}
    if not all(1 <= side < 2**31 for side in said.values()):
        shown = "x".join(f"{side:g}" for side in said.values())
        raise entry.wrong(f"has the size {shown}; correct w and h")
    if len(said) == 2:
        return int(said["w"]), int(said["h"])
    if not said and image != whole and _PIXELS & entry.said.keys():
        if not whole.is_file():
            raise entry.wrong("has neither w nor h, and the photo that it names is missing; write w and h there")
        image = whole
    shape = _shape(entry)
    if not said and shape is not None and image.is_file():
        return size_for(image, shape)
    width, height = size_of(image)
    if "w" in said:
        return int(said["w"]), max(1, round(height * said["w"] / width))
    return (max(1, round(width * said["h"] / height)), int(said["h"])) if said else (width, height)


def _shape(entry: Entry) -> tuple[float, float] | None:
    """Width and height up to a factor, as the middle of the image tells them, or angles of view; None without."""
    if {"cx", "cy"} <= entry.said.keys():
        return entry.number("cx"), entry.number("cy")
    angles = [entry.number(f"camera_angle_{axis}", math.nan) for axis in "xy"]
    if all(0 < angle < math.pi for angle in angles):
        return math.tan(angles[0] / 2), math.tan(angles[1] / 2)
    return None


def _intrinsics(entry: Entry, size: tuple[int, int]) -> Float[Tensor, "3 3"]:
    def focal(axis: str, extent: int) -> float | None:
        if f"fl_{axis}" in entry.said:
            return entry.number(f"fl_{axis}")
        if f"camera_angle_{axis}" not in entry.said:
            return None
        angle = entry.number(f"camera_angle_{axis}")
        if not 0 < angle < math.pi:
            raise entry.wrong(f"has camera_angle_{axis} = {angle:g}, not an angle of view; export the poses again")
        return 0.5 * extent / math.tan(0.5 * angle)

    if "K" in entry.said and "fl_x" not in entry.said:
        return checked_intrinsics(entry, entry.numbers("K", 9).reshape(3, 3))
    fx, fy = focal("x", size[0]), focal("y", size[1])
    if fx is None:
        raise entry.wrong("has neither fl_x, K nor camera_angle_x; export the poses again")
    return pinhole(fx, fx if fy is None else fy, entry.number("cx", size[0] / 2), entry.number("cy", size[1] / 2))


def _viewmat(entry: Entry) -> Float[Tensor, "4 4"]:
    matrix = entry.affine("transform_matrix")
    return entry.viewmat(matrix[:, :3], matrix[:, 3], OPENGL)
