"""The files of a COLMAP sparse model: cameras, registered images and points, binary or text."""

import math
import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from etsplat.core.errors import InputError

Row = TypeVar("Row")

_MODELS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"),
    *("SIMPLE_DIVISION", "DIVISION", "SIMPLE_FISHEYE", "FISHEYE", "EUCM", "EQUIRECTANGULAR"),
)
PARAMETERS = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8}
PARAMETERS |= {"FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12}
PARAMETERS |= {"RAD_TAN_THIN_PRISM_FISHEYE": 16, "SIMPLE_DIVISION": 4, "DIVISION": 5, "SIMPLE_FISHEYE": 3}
PARAMETERS |= {"FISHEYE": 4, "EUCM": 6, "EQUIRECTANGULAR": 2}


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
        InputError: the file is missing, cut short or malformed.
    """

    def binary(reader: _Reader) -> tuple[int, ColmapCamera]:
        identity, kind, width, height = reader.numbers("iiQQ")
        if not 0 <= kind < len(_MODELS):
            raise _unknown(reader.path, kind)
        name = _MODELS[kind]
        return identity, ColmapCamera(name, width, height, reader.numbers(f"{PARAMETERS[name]}d"))

    def text(line: str) -> tuple[int, ColmapCamera]:
        words = _words(line, 5)
        if words[1] not in PARAMETERS:
            raise _unknown(model / "cameras.txt", words[1])
        params = tuple(float(word) for word in words[4:])
        return int(words[0]), ColmapCamera(words[1], int(words[2]), int(words[3]), params)

    return dict(_rows(model / "cameras", binary, text))


def read_images(model: Path) -> list[ColmapImage]:
    """All registered images of a sparse model, from `images.bin` or else `images.txt`.

    Raises:
        InputError: the file is missing, cut short or malformed.
    """

    def binary(reader: _Reader) -> ColmapImage:
        _, w, x, y, z, tx, ty, tz, camera = reader.numbers("I7dI")
        name = reader.text()
        reader.skip(24 * reader.numbers("Q")[0])
        return ColmapImage(name, camera, (w, x, y, z), (tx, ty, tz))

    def text(line: str) -> ColmapImage:
        words = _words(line, 10, splits=9)  # names may have spaces
        w, x, y, z, tx, ty, tz = (float(word) for word in words[1:8])
        return ColmapImage(words[9], int(words[8]), (w, x, y, z), (tx, ty, tz))

    return _rows(model / "images", binary, text, _image_lines)


def count_images(model: Path) -> float:
    """Registered images of a sparse model; 0 where that cannot be read, but more than any number of the first model."""
    with suppress(InputError, OSError):
        path = model / "images.bin"
        return _Reader(path).numbers("Q")[0] if path.is_file() else len(read_images(model))
    return math.inf if model.name == "0" else 0


def read_points(model: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """Positions (P, 3) float64 and colours (P, 3) uint8 from `points3D.bin` or else `points3D.txt`; None without both.

    Raises:
        InputError: the file is cut short or malformed.
    """

    def binary(reader: _Reader) -> tuple[float, ...]:
        row = reader.numbers("Q3d3BdQ")
        reader.skip(8 * row[8])
        return row[1:7]

    if not any((model / f"points3D.{suffix}").is_file() for suffix in ("bin", "txt")):
        return None
    rows = _rows(model / "points3D", binary, lambda line: tuple(float(word) for word in _words(line, 7)[1:7]))
    table = np.array(rows, dtype=np.float64).reshape(-1, 6)
    table = table[np.isfinite(table).all(axis=1)]
    return table[:, :3], table[:, 3:].clip(0, 255).astype(np.uint8)


class _Reader:
    """Little-endian records from a file; InputError when it ends early."""

    def __init__(self, path: Path) -> None:
        self.path, self._data, self._at = path, path.read_bytes(), 0

    def numbers(self, layout: str) -> tuple:
        return struct.unpack("<" + layout, self.skip(struct.calcsize("<" + layout)))

    def text(self) -> str:
        end = self._data.find(b"\0", self._at)
        return self.skip(1 + (end if end >= 0 else len(self._data)) - self._at)[:-1].decode("utf-8", errors="replace")

    def skip(self, size: int) -> bytes:
        """What is skipped."""
        self._at += size
        if self._at > len(self._data):
            raise InputError(f"scene {self.path}: the file is cut short; export the model again")
        return self._data[self._at - size : self._at]


def _filled(lines: list[str]) -> list[str]:
    return [line for line in lines if line.strip()]


def _image_lines(lines: list[str]) -> list[str]:
    """Those of images: each is followed by one of key points, which may be empty, or left out by an editor."""
    found, key_points = [], False
    for line in lines:
        if key_points and not _is_image(line):
            key_points = False
        elif line.strip():
            found.append(line)
            key_points = True
    return found


def _is_image(line: str) -> bool:
    """Rather than key points, which are three numbers each."""
    words = line.split(maxsplit=10)
    if len(words) < 10:
        return False
    try:
        float(line.rsplit(maxsplit=1)[-1])
    except ValueError:
        return True
    return len(words) == 10 or len(line.split()) % 3 != 0


def _unknown(path: Path, model: object) -> InputError:
    return InputError(f"scene {path}: unknown camera model {model}; run `colmap image_undistorter` first")


def _rows(
    path: Path,
    binary: Callable[[_Reader], Row],
    text: Callable[[str], Row],
    those: Callable[[list[str]], list[str]] = _filled,
) -> list[Row]:
    """All records of `path`.bin, or else what `those` lines of `path`.txt say that are no comments."""
    if path.with_suffix(".bin").is_file():
        reader = _Reader(path.with_suffix(".bin"))
        return [binary(reader) for _ in range(reader.numbers("Q")[0])]
    path = path.with_suffix(".txt")
    if not path.is_file():
        raise InputError(f"scene {path}: no such file; export the model again")
    lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    rows = []
    for line in those([line for line in lines if not line.startswith("#")]):
        try:
            rows.append(text(line))
        except ValueError as error:
            raise InputError(f"scene {path}: malformed line `{line[:60]}` ({error}); export it again") from error
    return rows


def _words(line: str, least: int, splits: int = -1) -> list[str]:
    words = line.split(maxsplit=splits)
    if len(words) < least:
        raise ValueError("too few numbers")
    return words
