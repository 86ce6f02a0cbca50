"""Polycam's raw data: `keyframes/corrected_cameras/N.json` and `corrected_images/N.jpg`, or without "corrected_".

Each JSON file has `t_00` to `t_23`, the first three rows of the camera's matrix to the world, with ARKit's axes
(camera: x right, y up, looking along -z; world: y up, metres), and `fx`, `fy`, `cx`, `cy` in pixels of an image of
`width` x `height`, without distortion. Source: Polycam's own description of its raw data (github.com/PolyCam/polyform)
and what nerfstudio takes the fields for.
"""

from pathlib import Path

import torch

from etsplat.core.errors import InputError
from etsplat.data.frames import Frame, Listing, Wanted, find_image, pinhole
from etsplat.data.scene_files import OPENGL, Entry, points_beside, read_object

MARK = "keyframes/cameras/"
RANK = 3

_KINDS = (("corrected_cameras", "corrected_images"), ("cameras", "images"))
"""Folders of cameras and of their images; those that Polycam corrected come first."""


def recognises(folder: Path) -> bool:
    """Whether there are keyframes with cameras."""
    return any((folder / "keyframes" / cameras).is_dir() for cameras, _ in _KINDS)


def list_frames(folder: Path, wanted: Wanted) -> Listing:
    """The keyframes, with Polycam's corrections where it made them; points of `points.ply`.

    Raises:
        InputError: a file is damaged, or a number missing; a mask is missing.
    """
    keyframes = folder / "keyframes"
    cameras, images = next(
        ((cameras, images) for cameras, images in _KINDS if any((keyframes / cameras).glob("*.json"))), _KINDS[1]
    )
    paths = sorted((keyframes / cameras).glob("*.json"))
    if not paths:
        raise InputError(f"scene {keyframes / cameras}: holds no cameras; export the raw data again")
    place = keyframes / images if wanted.images is None else folder / wanted.images
    frames = [_frame(folder, place, path, wanted) for path in paths]
    return Listing(frames, points=points_beside(folder, frames))


def _frame(folder: Path, place: Path, path: Path, wanted: Wanted) -> Frame:
    entry = Entry(path, f"camera {path.stem}", read_object(path))
    rows = torch.tensor(
        [[entry.number(f"t_{row}{column}") for column in range(4)] for row in range(3)], dtype=torch.float64
    )
    image = find_image(place, f"{path.stem}.jpg", path)
    K = pinhole(*(entry.number(key) for key in ("fx", "fy", "cx", "cy")))
    viewmat = entry.viewmat(rows[:, :3], rows[:, 3], OPENGL)
    return Frame(image.name, image, wanted.mask_of(folder, image.name, path), viewmat, K, entry.size())
