"""Bundler's `bundle.out` (v0.3) beside `list.txt`, the list of its images, as many other programs write it too.

A camera is a focal length in pixels, k1, k2, a rotation R and a translation t: P = R X + t, p = -P / P.z, and a point
is seen at f (1 + k1 |p|^2 + k2 |p|^4) p, from the middle of the image, with y up: the camera looks along -z. A focal
length of 0 stands for an image without a place. Points follow: position, colour, and the images that show them.
Source: Bundler v0.4 User's Manual, section VI (cs.cornell.edu/~snavely/bundler).
"""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.data.frames import Frame, Listing, Points, Wanted
from etsplat.data.scene_files import (
    OPENGL,
    Entry,
    brown_lens,
    pinhole_of,
    placed_image,
    read_text,
    size_of,
    unplaced_note,
)

MARK = "bundle.out"
RANK = 7

_PLACES = ("bundle.out", "bundle/bundle.out")
_LISTS = ("list.txt", "bundle/list.txt", "bundle.list.txt")


def recognises(folder: Path) -> bool:
    """Whether the file is there."""
    return any((folder / place).is_file() for place in _PLACES)


def list_frames(folder: Path, wanted: Wanted) -> Listing:
    """The images that have a place, sorted by name, and the points.

    Raises:
        InputError: a file is missing, cut short or of another version; the lists have different lengths; a mask is
            missing.
    """
    path = next((folder / place for place in _PLACES if (folder / place).is_file()), folder / _PLACES[0])
    numbers, cameras, points = _numbers(path)
    images = _images(folder, path)
    if len(images) != cameras:
        raise InputError(
            f"scene {path}: has {cameras} cameras, but the list has {len(images)} images; export both again"
        )
    frames = []
    for index, name in enumerate(images):
        values = numbers[15 * index : 15 * index + 15]
        if values[0] == 0:
            continue
        entry = Entry(path, f"camera {index} ({name})", {})
        if not bool(values.isfinite().all()):
            raise entry.wrong("has numbers that are not finite; export it again")
        found, image = placed_image(folder, name, path, wanted)
        size, rotation = size_of(image), values[3:12].reshape(3, 3).T
        focal, k1, k2 = values[:3].tolist()
        viewmat = entry.viewmat(rotation, -rotation @ values[12:15], OPENGL)
        lens = brown_lens("lens distortion (k1, k2)", k1, k2)
        mask = wanted.mask_of(folder, found, path)
        frames.append(Frame(found, image, mask, viewmat, pinhole_of(focal, (0.0, 0.0), size), size, lens))
    frames.sort(key=lambda frame: frame.name)
    return Listing(frames, points=points, notes=unplaced_note(cameras - len(frames), cameras))


def _numbers(path: Path) -> tuple[Float[Tensor, " N"], int, Points | None]:
    """All numbers of the cameras, how many cameras, and the points."""
    lines = read_text(path, "ascii").splitlines()
    if not lines or not lines[0].startswith("# Bundle file v0.3"):
        raise InputError(f"scene {path}: is no bundle file of version 0.3; export it as that")
    try:
        words = lines[1].split()
        cameras, points = int(words[0]), int(words[1])
        if not (0 <= cameras <= len(lines) // 5 and 0 <= points <= len(lines) // 3):
            raise ValueError("is cut short")
        start = 2 + 5 * cameras
        rows = [[float(word) for word in line.split()] for line in lines[2:start]]
        if [len(row) for row in rows] != [3] * (5 * cameras):
            raise ValueError("has a camera that is not five lines of three numbers")
        ends = lines[start : start + 3 * points]
        if len(ends) != 3 * points:
            raise ValueError("is cut short")
        places = [[float(word) for word in line.split()] for line in ends[::3]]
        colors = [[float(word) for word in line.split()] for line in ends[1::3]]
        if any(len(row) != 3 for row in (*places, *colors)):
            raise ValueError("has a point without three coordinates and a colour")
    except (ValueError, IndexError) as error:
        raise InputError(f"scene {path}: cannot be read ({str(error)[:80]}); export it again") from error
    found = torch.tensor(rows, dtype=torch.float64).reshape(-1)
    xyz, rgb = torch.tensor(places, dtype=torch.float64).reshape(-1, 3), torch.tensor(colors).float().reshape(-1, 3)
    finite = xyz.isfinite().all(dim=1) & rgb.isfinite().all(dim=1)
    xyz, rgb = xyz[finite], (rgb[finite] / 255).clamp(0, 1)
    return found, cameras, (xyz, rgb) if len(xyz) else None


def _images(folder: Path, bundle: Path) -> list[str]:
    """The names of the images: the first word of each line, of which a second and a third tell the focal length."""
    path = next((folder / name for name in _LISTS if (folder / name).is_file()), None)
    if path is None:
        raise InputError(f"scene {bundle}: no list.txt beside it with the names of the images; copy it there")
    return [_name(line) for line in read_text(path).splitlines() if line.strip()]


def _name(line: str) -> str:
    """Without the two numbers that may follow; names may have spaces."""
    words = line.strip().rsplit(maxsplit=2)
    return words[0] if len(words) == 3 and words[1] == "0" else line.strip()
