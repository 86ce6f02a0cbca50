"""What layouts of research share: cameras that are written as matrices, and photos that are told by their order."""

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.data.frames import Wanted, find_image, pinhole
from etsplat.data.scene_files import Entry, placed_image, size_of
from etsplat.io.images import photos_in

_SKEW = 1e-4
"""Of the focal length: less than a tenth of a pixel in photos of a thousand, which single precision may leave."""


def checked_intrinsics(entry: Entry, matrix: Float[Tensor, "3 3"]) -> Float[Tensor, "3 3"]:
    """K of a matrix of intrinsics up to a factor, float64.

    Raises:
        InputError: it has skew, or is no such matrix.
    """
    K = matrix / matrix[2, 2]
    skew, zeros = K[0, 1].abs(), torch.stack([K[1, 0], K[2, 0], K[2, 1]]).abs().max()
    if not (bool(K.isfinite().all()) and float(zeros) <= _SKEW and float(K.diagonal().min()) > 0):
        raise entry.wrong("has intrinsics that are no camera's; write fx 0 cx, 0 fy cy and 0 0 1 as rows")
    if float(skew) > _SKEW * float(K[0, 0]):
        raise entry.wrong(f"has skew ({float(skew):.3g} pixels), which is not read; calibrate without it")
    return pinhole(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))


def decomposed(entry: Entry, projection: Float[Tensor, "3 4"]) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "4 4"]]:
    """K, and world to camera with OpenCV's axes, of a matrix from the world to pixels up to a factor; float64.

    Raises:
        InputError: it is none of a camera, or of one with skew.
    """
    left = projection[:, :3]
    size = float(left.abs().max())
    if not (size > 0 and abs(float(torch.linalg.det(left / size))) > 1e-30):
        raise entry.wrong("has a matrix that projects onto no image; export the poses again")
    # M = K R is turned around, so that the orthogonal factor comes first: of the transpose of M with its rows reversed.
    Q, upper = torch.linalg.qr((left / size).flip(0).T)
    K, R = upper.T.flip(0, 1), Q.T.flip(0)
    signs = K.diagonal().sign()
    K, R = K * signs, R * signs[:, None]
    center = -torch.linalg.solve(left, projection[:, 3])
    turn = R * torch.linalg.det(R).sign()  # a factor of -1 is the same projection
    return checked_intrinsics(entry, K), entry.viewmat(turn.T, center)


def photos_by_order(
    folder: Path, places: Sequence[str], count: int, source: Path, wanted: Wanted
) -> list[tuple[str, Path, tuple[int, int]]]:
    """Name, file and size of intrinsics of photos that belong to poses by their order, which is that of their names.

    Args:
        folder: of the scene.
        places: folders in it where they may be; the first that is there counts.
        count: of the poses.
        source: what has the poses, for messages.
        wanted: other images; sizes are those of the photos that the layout itself has.

    Raises:
        InputError: there is no such folder, or it has another number of photos.
    """
    place = next((folder / name for name in places if (folder / name).is_dir()), None)
    if place is None:
        raise InputError(f"scene {source}: no folder {' or '.join(places)} beside it; copy the photos there")
    photos = _counted(place, count, source)
    files = photos if wanted.images is None else _counted(folder / wanted.images, count, source)
    return [(photo.name, file, size_of(photo)) for photo, file in zip(photos, files, strict=True)]


def _counted(place: Path, count: int, source: Path) -> list[Path]:
    """The photos in a folder, of which there must be so many."""
    found = photos_in(place)
    if len(found) != count:
        raise InputError(
            f"scene {source}: has {count} poses, but there are {len(found)} photos (JPEG, PNG) in {place}, and their"
            " order alone says which is whose; copy all of them there, and nothing else"
        )
    return found


def photo_by_name(
    folder: Path, place: str, name: str, source: Path, wanted: Wanted
) -> tuple[str, Path, tuple[int, int]]:
    """Name, file and size of intrinsics of the photo NAME, or with another ending, in the folder PLACE of a scene.

    Raises:
        InputError: it is no name.
    """
    photo = find_image(folder / place, name, source)
    image = photo if wanted.images is None else placed_image(folder, f"{place}/{name}", source, wanted)[1]
    return photo.name, image, size_of(photo if photo.is_file() else image)
