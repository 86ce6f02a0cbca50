"""Captures in COLMAP's layout: `images/` and `sparse/0/{cameras,images}.{bin,txt}`, undistorted.

COLMAP's poses are world-to-camera with OpenCV axes, its pixel centres at +0.5: our conventions, nothing to convert.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.scene.frames import Frame, find_mask, load_frames
from etsplat.scene.views import PosedViews, every_eighth

_MODELS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE"),
)
_PARAMETERS = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8}
_PARAMETERS |= {"FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12}


@dataclass(frozen=True)
class ColmapCamera:
    """A camera as COLMAP stores it; `params` in the model's order."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class ColmapImage:
    """A registered image: world-to-camera quaternion (w, x, y, z) and translation."""

    name: str
    camera: int
    quaternion: tuple[float, float, float, float]
    translation: tuple[float, float, float]


def load_colmap(folder: Path | str, masks: Path | str | None = None, *, width: int | None = None) -> PosedViews:
    """Read an undistorted COLMAP scene; every 8th image by name is test.

    Args:
        folder: holds `images/` and `sparse/0/` (or `sparse/`), binary or text; binary is preferred.
        masks: folder with a mask for every image (white inside the object). By default `masks/` of the scene if it is
            there; images with an alpha channel need none.
        width: shrink the images to this many pixels across (never enlarges).

    Returns:
        Views in COLMAP's own units.

    Raises:
        InputError: files are missing, cut short or malformed; camera models with distortion; a mask is missing;
            images as `etsplat.scene.frames.load_frames`.
    """
    folder = Path(folder)
    model = next((path for path in (folder / "sparse" / "0", folder / "sparse") if _has_model(path)), None)
    if model is None:
        raise InputError(
            f"scene {folder}: no sparse/0/cameras.bin or .txt; run COLMAP's mapper or choose another folder"
        )
    if masks is not None and not Path(masks).is_dir():
        raise InputError(f"masks {masks}: no such folder; check the path")
    mask_folder = Path(masks) if masks is not None else folder / "masks"
    cameras = read_cameras(model)
    images = sorted(read_images(model), key=lambda image: image.name)
    if not images:
        raise InputError(f"scene {folder}: the sparse model has no registered image; run COLMAP's mapper again")
    frames = []
    for image in images:
        if image.camera not in cameras:
            raise InputError(f"scene {model}: {image.name} uses camera {image.camera}, which is missing; export again")
        camera = cameras[image.camera]
        K = _intrinsics(model, image.name, camera)
        mask = find_mask(mask_folder, image.name) if mask_folder.is_dir() else None
        frames.append(
            Frame(image.name, folder / "images" / image.name, mask, _viewmat(image), K, (camera.width, camera.height))
        )
    train, test = every_eighth([frame.name for frame in frames])
    return load_frames(folder, frames, train, test, width=width)


def read_cameras(model: Path) -> dict[int, ColmapCamera]:
    """All cameras of a sparse model by their id, from `cameras.bin` or else `cameras.txt`.

    Raises:
        InputError: the file is cut short or malformed.
    """
    if (model / "cameras.bin").is_file():
        return dict(_cameras_from_binary(_Reader(model / "cameras.bin")))
    cameras = {}
    path = model / "cameras.txt"
    for line in _text_lines(path):
        words = line.split()
        try:
            if len(words) < 5:
                raise ValueError("too few numbers")
            params = tuple(float(word) for word in words[4:])
            cameras[int(words[0])] = ColmapCamera(words[1], int(words[2]), int(words[3]), params)
        except ValueError as error:
            raise InputError(f"scene {path}: malformed line `{line[:60]}` ({error}); export it again") from error
    return cameras


def read_images(model: Path) -> list[ColmapImage]:
    """All registered images of a sparse model, from `images.bin` or else `images.txt`.

    Raises:
        InputError: the file is missing, cut short or malformed.
    """
    if (model / "images.bin").is_file():
        return list(_images_from_binary(_Reader(model / "images.bin")))
    images = []
    path = model / "images.txt"
    # Every second line lists the image's key points, and may be empty.
    for line in _text_lines(path, keep_empty=True)[::2]:
        words = line.split(maxsplit=9)
        try:
            if len(words) < 10:
                raise ValueError("too few numbers")
            w, x, y, z, tx, ty, tz = (float(word) for word in words[1:8])
            images.append(ColmapImage(words[9], int(words[8]), (w, x, y, z), (tx, ty, tz)))
        except ValueError as error:
            raise InputError(f"scene {path}: malformed line `{line[:60]}` ({error}); export it again") from error
    return images


def _has_model(path: Path) -> bool:
    return any((path / f"cameras.{suffix}").is_file() for suffix in ("bin", "txt"))


class _Reader:
    """Little-endian records from a file; InputError when it ends early."""

    def __init__(self, path: Path) -> None:
        self.path, self._data, self._at = path, path.read_bytes(), 0

    def numbers(self, layout: str) -> tuple:
        size = struct.calcsize("<" + layout)
        if self._at + size > len(self._data):
            raise InputError(f"scene {self.path}: the file is cut short; export the model again")
        values = struct.unpack_from("<" + layout, self._data, self._at)
        self._at += size
        return values

    def text(self) -> str:
        end = self._data.find(b"\0", self._at)
        if end < 0:
            raise InputError(f"scene {self.path}: the file is cut short; export the model again")
        text = self._data[self._at : end].decode("utf-8", errors="replace")
        self._at = end + 1
        return text

    def skip(self, size: int) -> None:
        if self._at + size > len(self._data):
            raise InputError(f"scene {self.path}: the file is cut short; export the model again")
        self._at += size


def _cameras_from_binary(reader: _Reader) -> Iterator[tuple[int, ColmapCamera]]:
    for _ in range(reader.numbers("Q")[0]):
        identity, model, width, height = reader.numbers("iiQQ")
        if not 0 <= model < len(_MODELS):
            raise InputError(f"scene {reader.path}: unknown camera model {model}; run `colmap image_undistorter` first")
        name = _MODELS[model]
        yield identity, ColmapCamera(name, width, height, reader.numbers(f"{_PARAMETERS[name]}d"))


def _images_from_binary(reader: _Reader) -> Iterator[ColmapImage]:
    for _ in range(reader.numbers("Q")[0]):
        _, w, x, y, z, tx, ty, tz, camera = reader.numbers("I7dI")
        name = reader.text()
        reader.skip(24 * reader.numbers("Q")[0])
        yield ColmapImage(name, camera, (w, x, y, z), (tx, ty, tz))


def _text_lines(path: Path, keep_empty: bool = False) -> list[str]:
    if not path.is_file():
        raise InputError(f"scene {path}: no such file; export the model again")
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    return [line for line in lines if not line.startswith("#") and (keep_empty or line.strip())]


def _intrinsics(model: Path, name: str, camera: ColmapCamera) -> Float[Tensor, "3 3"]:
    if camera.model not in ("PINHOLE", "SIMPLE_PINHOLE"):
        raise InputError(
            f"scene {model}: {name} has a {camera.model} camera with lens distortion;"
            " run `colmap image_undistorter` and use its output folder"
        )
    if len(camera.params) != _PARAMETERS[camera.model] or camera.width < 1 or camera.height < 1:
        raise InputError(f"scene {model}: the camera of {name} is malformed; export the model again")
    fx, fy, cx, cy = camera.params if camera.model == "PINHOLE" else (camera.params[0], *camera.params)
    if not np.isfinite(camera.params).all() or min(fx, fy) <= 0:
        raise InputError(f"scene {model}: the camera of {name} has no positive focal length; export the model again")
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)


def _viewmat(image: ColmapImage) -> Float[Tensor, "4 4"]:
    q = np.array(image.quaternion)
    norm = np.linalg.norm(q)
    if not np.isfinite([*q, *image.translation]).all() or norm < 1e-9:
        raise InputError(f"scene: the pose of {image.name} is not finite; run COLMAP's mapper again")
    w, x, y, z = q / norm
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.tensor(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    viewmat[:3, 3] = torch.tensor(image.translation)
    return viewmat
