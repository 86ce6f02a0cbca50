"""LLFF's `poses_bounds.npy` beside `images/`, as NeRF's forward-facing captures have it.

A row of 17 numbers for each photo, the photos being sorted by name: a matrix of 3 rows and 5 columns, row by row, and
the nearest and the farthest depth, which are not read. Three of the columns are the camera's axes in the world: down,
right and backwards; then its place; then height, width and focal length in pixels, of the photos in `images/`, of
which `images_4/` and the like hold smaller copies. The principal point is the middle. The row does not say how a lens
distorts, which the COLMAP model that it was made of does (`sparse/`, which is read before it).
Source: LLFF's own description (github.com/Fyusion/LLFF) and its converter from COLMAP.
"""

from pathlib import Path

import torch

from etsplat.core.errors import InputError
from etsplat.data.frames import Frame, Listing, Wanted
from etsplat.data.matrix_cameras import photos_by_order
from etsplat.data.scene_files import OPENGL, Entry, pinhole_of, points_beside
from etsplat.io.arrays import load_npy

MARK = "poses_bounds.npy"
RANK = 11

_NUMBERS = 17

_MOST = 1_000_000
"""Photos, beyond which a file is none of poses."""


def recognises(folder: Path) -> bool:
    """Whether the file is there."""
    return (folder / MARK).is_file()


def list_frames(folder: Path, wanted: Wanted) -> Listing:
    """The photos, sorted by name; points of `points.ply`.

    Raises:
        InputError: the file is damaged; there are fewer or more photos than poses; a mask is missing.
    """
    path = folder / MARK
    rows = _rows(path)
    photos = photos_by_order(folder, _places(folder), len(rows), path, wanted)
    frames = []
    for index, (row, (name, image, _)) in enumerate(zip(rows, photos, strict=True)):
        entry = Entry(path, f"pose {index} ({name})", {"matrix": row[:15], "height": row[4], "width": row[9]})
        matrix, size = entry.numbers("matrix", 15).reshape(3, 5), entry.size()
        down, right, back, center = matrix[:, :4].unbind(dim=1)
        viewmat = entry.viewmat(torch.stack([right, -down, back], dim=1), center, OPENGL)
        mask = wanted.mask_of(folder, name, path)
        frames.append(Frame(name, image, mask, viewmat, pinhole_of(float(matrix[2, 4]), (0.0, 0.0), size), size))
    note = f"{MARK} does not say how the lens distorts: with COLMAP's model of these photos in sparse/, that is read"
    return Listing(frames, points=points_beside(folder, frames) if frames else None, notes=(note,))


def _rows(path: Path) -> list[list[float]]:
    try:
        numbers = load_npy(path)
    except ValueError as error:
        raise InputError(f"scene {path}: {error}; write it again") from error
    if numbers.ndim != 2 or numbers.shape[1] != _NUMBERS or len(numbers) > _MOST:
        raise InputError(f"scene {path}: has the shape {numbers.shape}; it must be {_NUMBERS} numbers for each photo")
    return numbers.astype("f8").tolist()


def _places(folder: Path) -> list[str]:
    """Where the photos are: `images/`, or else the largest copies that are there."""
    copies = [path.name for path in folder.glob("images_*") if path.name.removeprefix("images_").isdecimal()]
    return ["images", *sorted(copies, key=lambda name: int(name.removeprefix("images_")))]
