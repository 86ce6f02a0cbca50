"""The files of a COLMAP sparse model: cameras, registered images and points, binary or text."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from etsplat.core.errors import InputError

_MODELS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE"),
)
PARAMETERS = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8}
PARAMETERS |= {"FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12}


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


def read_points(model: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """Positions (P, 3) float64 and colours (P, 3) uint8 from `points3D.bin` or else `points3D.txt`; None without both.

    Raises:
        InputError: the file is cut short or malformed.
    """
    if (model / "points3D.bin").is_file():
        reader = _Reader(model / "points3D.bin")
        count = reader.numbers("Q")[0]
        rows = []
        for _ in range(count):
            row = reader.numbers("Q3d3BdQ")
            reader.skip(8 * row[8])
            rows.append(row[1:7])
    elif (model / "points3D.txt").is_file():
        path = model / "points3D.txt"
        try:
            rows = [tuple(float(word) for word in line.split()[1:7]) for line in _text_lines(path)]
        except ValueError as error:
            raise InputError(f"scene {path}: malformed line ({error}); export it again") from error
    else:
        return None
    if any(len(row) != 6 for row in rows):
        raise InputError(f"scene {model / 'points3D.txt'}: a line with too few numbers; export it again")
    table = np.array(rows, dtype=np.float64).reshape(-1, 6)
    table = table[np.isfinite(table).all(axis=1)]
    return table[:, :3], table[:, 3:].clip(0, 255).astype(np.uint8)


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
        yield identity, ColmapCamera(name, width, height, reader.numbers(f"{PARAMETERS[name]}d"))


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
