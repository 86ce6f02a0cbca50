"""What readers of other programs' files share: entries with numbers, poses, lenses, and where the images lie now."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from xml.etree import ElementTree

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.data.frames import Frame, Lens, Points, Wanted, find_image, pinhole
from etsplat.io.images import image_size, photos_in
from etsplat.io.json_text import parse_json
from etsplat.io.paths import path_within
from etsplat.io.ply_tables import GREY, load_points

POINTS = "points.ply"
"""In the folder of a layout that has no points of its own: points, in the frame of the poses."""

OPENGL = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64, device="cpu")
"""Signs of the axes of a camera that has y up and looks along -z, in those of one that has y down and looks along z."""

_ROUNDING = 1e-6

_AFAR = 1000.0
"""So many times the cameras' own spread from them, points cannot be in their frame."""


@dataclass(frozen=True)
class Entry:
    """What a file says of one thing.

    Attributes:
        path: of the file.
        name: of the thing, for error messages.
        said: by key.
    """

    path: Path
    name: str
    said: Mapping[str, Any]

    def wrong(self, what: str) -> InputError:
        """The error for something in it."""
        return InputError(f"scene {self.path}: {self.name} {what}")

    def number(self, key: str, default: float | None = None) -> float:
        """A number, which may be written as a text; without a default it must be there.

        Raises:
            InputError: it is missing or no number.
        """
        value = self.said.get(key, default)
        if value is None:
            raise self.wrong(f"has no {key}; export the poses again")
        if isinstance(value, int | float | str) and not isinstance(value, bool):
            with suppress(OverflowError, ValueError):  # an integer of hundreds of digits, a text
                return float(value)
        raise self.wrong(f"has {key} = {value!r:.40}, which is not a number; export the poses again")

    def numbers(self, key: str, count: int, default: list[float] | None = None) -> Float[Tensor, " N"]:
        """`floats` as a tensor, float64. Raises InputError as they do."""
        return torch.tensor(self.floats(key, count, default), dtype=torch.float64)

    def floats(self, key: str, count: int, default: list[float] | None = None) -> list[float]:
        """So many finite numbers: a list, a text with spaces between, or lists in a list.

        Raises:
            InputError: they are missing, fewer, more, or not finite.
        """
        value = self.said.get(key, default)
        if isinstance(value, str):
            value = value.split()
        if isinstance(value, list) and value and all(isinstance(row, list) for row in value):
            value = [number for row in value for number in row]
        if isinstance(value, list) and len(value) == count:
            with suppress(OverflowError, ValueError, TypeError):
                found = [float(number) for number in value]
                if all(map(math.isfinite, found)):
                    return found
        raise self.wrong(f"has no {key} of {count} finite numbers; export the poses again")

    def affine(self, key: str) -> Float[Tensor, "3 4"]:
        """The first three rows of a matrix of three or four, the last of which is 0 0 0 1; as `numbers` takes it.

        Raises:
            InputError: it is missing, of another size, not finite, or its last row is another.
        """
        said = self.said.get(key)
        three = len(said.split()) == 12 if isinstance(said, str) else isinstance(said, list) and len(said) == 3
        matrix = self.numbers(key, 12 if three else 16).reshape(-1, 4)
        if bool((matrix[3:, :3].abs() > _ROUNDING).any()):
            raise self.wrong(f"has a {key} whose last row is not 0 0 0 1; if transposed, write rows as columns")
        return matrix[:3]

    def whole(self, key: str, default: int | None = None) -> int:
        """A whole number, not negative; without a default it must be there.

        Raises:
            InputError: it is missing or no such number.
        """
        value = self.number(key, default)
        if not (value == value // 1 and 0 <= value < 2**64):
            raise self.wrong(f"has {key} = {value:g}, which is no whole number; export it again")
        return int(value)

    def text(self, key: str, default: str | None = None) -> str:
        """A text, or a number as one; without a default it must be there.

        Raises:
            InputError: it is missing or something else.
        """
        value = self.said.get(key, default)
        if isinstance(value, int | str) and not isinstance(value, bool):
            return str(value)
        raise self.wrong(f"has no {key}; export it again")

    def inner(self, key: str) -> "Entry":
        """An object in it.

        Raises:
            InputError: there is none.
        """
        value = self.said.get(key)
        if not isinstance(value, dict):
            raise self.wrong(f"has no {key}; export it again")
        return Entry(self.path, self.name, value)

    def size(self) -> tuple[int, int]:
        """`width` and `height`.

        Raises:
            InputError: they are no size of an image.
        """
        width, height = self.number("width"), self.number("height")
        if not (1 <= width < 2**31 and 1 <= height < 2**31):
            raise self.wrong(f"has the size {width:g}x{height:g}; correct width and height")
        return int(width), int(height)

    def viewmat(
        self, rotation: Float[Tensor, "3 3"], center: Float[Tensor, "3"], axes: Float[Tensor, "3"] | None = None
    ) -> Float[Tensor, "4 4"]:
        """World to camera, OpenCV axes, float64.

        Args:
            rotation: camera to world.
            center: of the camera, in the world.
            axes: of the camera, as signs of OpenCV's; None for those.

        Raises:
            InputError: the rotation scales or mirrors, or is far from one.
        """
        if not torch.allclose(rotation.T @ rotation, torch.eye(3).double(), atol=1e-3) or rotation.det() < 0:
            raise self.wrong("has a pose that scales or mirrors; export rigid poses")
        camera_to_world = torch.eye(4, dtype=torch.float64)
        camera_to_world[:3, :3] = rotation if axes is None else rotation * axes
        camera_to_world[:3, 3] = center
        return torch.linalg.inv(camera_to_world)


def quaternion_rotation(w: float, x: float, y: float, z: float) -> Float[Tensor, "3 3"]:
    """The rotation of a unit quaternion, float64."""
    return torch.tensor(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ],
        dtype=torch.float64,
    )


def read_text(path: Path, encoding: str = "utf-8") -> str:
    """What a text file says; bytes that are none of the encoding's are replaced.

    Raises:
        InputError: it cannot be read.
    """
    try:
        return path.read_text(encoding=encoding, errors="replace")
    except OSError as error:
        raise InputError(f"scene {path}: cannot be read ({error.strerror}); copy it there again") from error


def read_json(path: Path) -> Any:
    """What a JSON file says.

    Raises:
        InputError: it cannot be read, or is no JSON.
    """
    try:
        return parse_json(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"scene {path}: cannot be read ({error.strerror}); check its permissions") from error
    except ValueError as error:
        detail = str(error).splitlines()[0]
        raise InputError(f"scene {path}: not valid JSON ({detail}); export the poses again") from error


def read_object(path: Path) -> dict[str, Any]:
    """What a JSON file says.

    Raises:
        InputError: it is no JSON object.
    """
    document = read_json(path)
    if not isinstance(document, dict):
        raise InputError(f"scene {path}: expected a JSON object; export the poses again")
    return document


def entries_of(path: Path, document: Mapping[str, Any], key: str, name: str) -> list[Entry]:
    """The objects of a list in a JSON file, named by what each is and its place.

    Raises:
        InputError: there is no such list of objects.
    """
    found = document.get(key)
    if not isinstance(found, list) or not all(isinstance(entry, dict) for entry in found):
        raise InputError(f"scene {path}: no list `{key}` of objects; export the poses again")
    return [Entry(path, f"{name} {index}", entry) for index, entry in enumerate(found)]


def read_xml(path: Path) -> ElementTree.Element:
    """The root of an XML file.

    Raises:
        InputError: it is no XML, or declares entities, which may unpack to anything.
    """
    try:
        data = path.read_bytes()
        if b"<!" in data.replace(b"<!--", b"").replace(b"<![CDATA[", b""):
            raise InputError(f"scene {path}: declares types or entities, which are not read; export it again")
        return ElementTree.fromstring(data)
    except OSError as error:
        raise InputError(f"scene {path}: cannot be read ({error.strerror}); check its permissions") from error
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        detail = str(error).splitlines()[0]
        raise InputError(f"scene {path}: not valid XML ({detail}); export the poses again") from error


def only_one(folder: Path, found: list[Path]) -> Path | None:
    """The file of a kind, or None.

    Raises:
        InputError: there are several.
    """
    if len(found) > 1:
        names = ", ".join(path.name for path in found[:4])
        raise InputError(f"scene {folder}: {len(found)} files say where the cameras are ({names}); leave one there")
    return found[0] if found else None


def head_of(path: Path, size: int = 4096) -> str:
    """The beginning of a file as text; empty where it cannot be read."""
    try:
        with open(path, "rb") as file:
            data = file.read(size)
    except OSError:
        return ""
    utf16 = data[:2] in (b"\xff\xfe", b"\xfe\xff")
    return data.decode("utf-16" if utf16 else "utf-8-sig", errors="ignore")


def placed_image(folder: Path, said: str, source: Path, wanted: Wanted, *, any_end: bool = True) -> tuple[str, Path]:
    """Where an image lies that a file names: in the folder or its `images`, by `placed_file`; without its ending too.

    With `wanted.images` in that folder alone.

    Raises:
        InputError: it is no name.
    """
    places = [folder / "images", folder] if wanted.images is None else [folder / wanted.images]
    return placed_file(places, said, source, find_image, any_end=any_end)


def placed_file(
    places: Sequence[Path],
    said: str,
    source: Path,
    find: Callable[[Path, str, Path], Path] = path_within,
    *,
    least: int = 1,
    any_end: bool = False,
) -> tuple[str, Path]:
    """Where a file lies that another names as it was called on another computer.

    That name in one of the places, the first of these first. Of a path that leads out of them, as from the root of
    another computer, the end, as much of it as there is.

    Args:
        places: folders.
        said: the path.
        source: what says it, for messages.
        find: the file of a name in a folder, with another ending perhaps.
        least: parts of such an end: with 2 its folder too, of what could be taken for another file.
        any_end: the end of any path.

    Returns:
        The name, from the first folder on that is here too, and the file; one that is not there if none is.

    Raises:
        InputError: it is no name.
    """
    whole = PurePosixPath(said.replace("\\", "/")).parts
    parts = [part for part in whole if part not in ("/", "..") and part[1:] != ":"]
    starts = max(1, len(parts) - least + 1) if any_end or len(parts) < len(whole) else 1
    ends = ["/".join(parts[start:]) for start in range(starts)] if parts else [said]
    for name in ends:
        for place in places:
            path = find(place, name, source)
            if path.is_file():
                return name, path
    return ends[0], places[0] / (ends[0] if len(parts) == len(whole) else ends[-1])


def name_below(image: Path, folder: Path) -> str:
    """How an image is called in a folder of masks or depth maps: train/r_0.png; a/0.png for images/a/0.png."""
    if not image.is_relative_to(folder):
        return image.name
    parts = image.relative_to(folder).parts
    return "/".join(parts[1:] if len(parts) > 1 and parts[0].startswith("images") else parts)


def size_of(image: Path) -> tuple[int, int]:
    """Of the file; of a missing one, which is reported later with all others, any."""
    return image_size(image) if image.is_file() else (1, 1)


def pinhole_of(focal: float, offset: tuple[float, float], size: tuple[int, int], fy: float | None = None) -> Tensor:
    """K of a focal length in pixels and a principal point in pixels from the middle of the image."""
    return pinhole(focal, focal if fy is None else fy, size[0] / 2 + offset[0], size[1] / 2 + offset[1])


def brown_lens(told: str, k1: float, k2: float = 0.0, k3: float = 0.0, p1: float = 0.0, p2: float = 0.0) -> Lens | None:
    """Radial and tangential distortion as OpenCV has them; None without."""
    if k3 != 0:
        return Lens("FULL_OPENCV", (k1, k2, p1, p2, k3, 0.0, 0.0, 0.0), told)
    return Lens("OPENCV", (k1, k2, p1, p2), told) if any((k1, k2, p1, p2)) else None


def fisheye_lens(told: str, k1: float, k2: float, k3: float, k4: float) -> Lens:
    """Distortion by the angle to the axis, as OpenCV has it."""
    return Lens("OPENCV_FISHEYE", (k1, k2, k3, k4), told)


def points_of(places: Float[Tensor, "P 3"], colors: Float[Tensor, "P 3"] | None) -> Points:
    """Points of a file, float64; colours from 0 to 255, grey without."""
    shown = torch.full(places.shape, GREY) if colors is None else (colors / 255).clamp(0, 1).float()
    return places, shown


def points_beside(folder: Path, frames: Iterable[Frame]) -> Points | None:
    """The points of `points.ply`, if it is there.

    Raises:
        InputError: it cannot be read, or its points are so far from the cameras that they are in another frame.
    """
    if not (folder / POINTS).is_file():
        return None
    points = load_points(folder / POINTS)
    if not len(points[0]):
        return None
    centers = torch.stack([-frame.viewmat[:3, :3].T @ frame.viewmat[:3, 3] for frame in frames])
    spread = float((centers - centers.mean(dim=0)).norm(dim=1).max())
    distance = float((points[0].median(dim=0).values - centers.mean(dim=0)).norm())
    if spread > 0 and distance > _AFAR * spread:
        raise InputError(
            f"scene {folder / POINTS}: lies {distance:.3g} from the cameras, which are {spread:.3g} from each other: it"
            " is in another frame; export both in the same coordinate system, or remove it"
        )
    return points


def unplaced_note(count: int, total: int, what: str = "have no pose") -> tuple[str, ...]:
    """That some of the images are left out; none where none is."""
    return (f"{count} of {total} photos {what} and are left out",) if count else ()


def unplaced_beside(frames: Iterable[Frame]) -> tuple[str, ...]:
    """A note on photos that lie beside those with a pose and have none."""
    placed = {frame.image.with_suffix("") for frame in frames}
    beside = {
        path.with_suffix("")
        for folder in {stem.parent for stem in placed if stem.parent.is_dir()}
        for path in photos_in(folder)
        if not path.stem.endswith(("_mask", "_masked"))
    }
    return unplaced_note(len(beside - placed), len(beside | placed))
