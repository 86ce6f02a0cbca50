"""cameras.json of a run: the cameras of its photos as it refined them (docs/conventions.md, Refined cameras)."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from etsplat.core.errors import InputError
from etsplat.io.atomic import atomic_write
from etsplat.io.camera_path_files import pose_problem
from etsplat.io.json_text import entries_problem, is_number, parse_json

CAMERAS_FILE = "cameras.json"
"""In the folder of a run that refined cameras."""

FORMAT = "etsplat cameras 1"

_ABOUT = (
    "world to camera, x right, y down, z forward, in units of the capture; intrinsics in pixels; how far each camera "
    "is from where it was given: the angle, and the shift in units of the capture and in parts of the distance of what "
    "it shows. Cameras with training = false were kept from training, and aligned to the result"
)

_KINDS = {
    "width": int,
    "height": int,
    "training": bool,
    "turned_degrees": float,
    "shifted": float,
    "shifted_of_distance": float,
}


@dataclass(frozen=True)
class RefinedCamera:
    """One camera.

    Attributes:
        viewmat: four rows of four, world to camera, OpenCV axes, in the capture's own units.
        K: three rows of three, in pixels.
        width: of the photo in pixels.
        height: likewise.
        training: whether the model was fitted to its photo.
        turned_degrees: angle from where it was given.
        shifted: distance from there, in the capture's own units.
        shifted_of_distance: the same in parts of the distance of what it shows.
    """

    viewmat: list[list[float]]
    K: list[list[float]]
    width: int
    height: int
    training: bool
    turned_degrees: float
    shifted: float
    shifted_of_distance: float


def write_refined_cameras(folder: Path, cameras: Mapping[str, RefinedCamera]) -> None:
    """As cameras.json into a folder. Atomic.

    Args:
        folder: of the run.
        cameras: by the name of their photos.

    Raises:
        InputError: the file cannot be written.
    """
    rows = {name: asdict(camera) for name, camera in cameras.items()}
    text = json.dumps({"format": FORMAT, "about": _ABOUT, "cameras": rows}, indent=1, allow_nan=False)
    with atomic_write(folder / CAMERAS_FILE) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def read_refined_cameras(folder: Path) -> dict[str, RefinedCamera]:
    """Those of a run's folder by the names of their photos; empty if it has none.

    Raises:
        InputError: the file cannot be read, or has a camera that is none.
    """
    path = folder / CAMERAS_FILE
    if not path.is_file():
        return {}
    try:
        found = parse_json(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise InputError(f"{path}: is not JSON ({error}); delete it to have cameras as they were given") from error
    if not isinstance(found, dict) or found.get("format") != FORMAT or not isinstance(found.get("cameras"), dict):
        raise InputError(f"{path}: is no file of refined cameras ({FORMAT}); delete it to have them as they were given")
    for name, row in found["cameras"].items():
        if problem := _problem(row):
            raise InputError(f"{path}: camera {name!r:.60} {problem}; delete the file to have cameras as given")
    fields = RefinedCamera.__dataclass_fields__
    return {name: RefinedCamera(**{key: row[key] for key in fields}) for name, row in found["cameras"].items()}


def _problem(row: Any) -> str | None:
    """What is wrong with a camera, or None."""
    if problem := entries_problem(row, _KINDS, _KINDS):
        return problem
    if problem := pose_problem(row.get("viewmat")):
        return f"has a viewmat that is wrong: it {problem}"
    K = row.get("K")
    shaped = isinstance(K, list) and len(K) == 3 and all(isinstance(line, list) and len(line) == 3 for line in K)
    if not shaped or not all(is_number(value) for line in K for value in line):
        return "has no K of three rows of three numbers"
    if not (K[0][0] > 0 and K[1][1] > 0 and K[0][1] == K[1][0] == 0 and K[2] == [0, 0, 1]):
        return "has a K that is no matrix of a pinhole camera"
    if not (1 <= row["width"] <= 1 << 26 and 1 <= row["height"] <= 1 << 26):
        return "has a width or height that no photo has"
    return None
