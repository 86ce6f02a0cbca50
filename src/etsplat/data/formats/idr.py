"""Scenes as IDR, VolSDF and NeuS have them (DTU, BlendedMVS): `cameras_sphere.npz` or `cameras.npz`, `image/`, `mask/`.

`world_mat_N` leads from the world to pixels, K [R | t], and `scale_mat_N` from a frame in which the object is within
the unit sphere to the world, by a factor and an offset. The frame of the sphere is read, in which these programs work:
world_mat_N times scale_mat_N is taken apart into K, R and t, with OpenCV's axes. The way back to the world is in the
listing's `georeference`. Photo N is the one at place N by name, and so is mask N. The centre of the first pixel is at
0 (the converter for photos of one's own has (w - 1) / 2 as the middle), where ours is at 0.5.
Source: what IDR's and NeuS' data loaders take the fields for, and NeuS' converter for COLMAP.
"""

from collections.abc import Iterator
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.core.spelling import option
from etsplat.data.frames import MASK_FOLDER, Frame, Listing, Wanted
from etsplat.data.matrix_cameras import decomposed, photos_by_order
from etsplat.data.scene_files import Entry, points_beside
from etsplat.io.arrays import load_npz, names_in_npz
from etsplat.io.georeference import Georeference
from etsplat.io.images import photos_in

MARK = "cameras_sphere.npz or cameras.npz of NeuS"
RANK = 10

_FILES = ("cameras_sphere.npz", "cameras.npz")
_PHOTOS = ("image", "rgb", "images")
_MASKS = "mask"

_ALIKE = 1e-4
"""Of the scale: so far apart may matrices in single precision be that are one."""


def recognises(folder: Path) -> bool:
    """Whether one of the files is there."""
    return any((folder / name).is_file() for name in _FILES)


def list_frames(folder: Path, wanted: Wanted) -> Listing:
    """The photos, sorted by name, with masks of `mask/` if that is there; points of `points.ply`.

    Raises:
        InputError: the file is damaged or lacks matrices; these are none of cameras, or have several frames; there are
            fewer or more photos or masks than cameras; a mask is missing.
    """
    path = next((folder / name for name in _FILES if (folder / name).is_file()), folder / _FILES[0])
    cameras = _cameras(path)
    photos = photos_by_order(folder, _PHOTOS, len(cameras), path, wanted)
    masks = _masks(folder, [name for name, _, _ in photos], path, wanted)
    scales = [entry.affine("scale_mat") for entry in cameras]
    georeference = _georeference(cameras[0], scales[0])
    frames = []
    for entry, scale, (name, image, size), mask in zip(cameras, scales, photos, masks, strict=True):
        if not torch.allclose(scale, scales[0], rtol=_ALIKE, atol=_ALIKE * float(scales[0].abs().max())):
            raise entry.wrong("has another scale_mat than camera 0: the cameras are in several frames; export one")
        bottom = torch.tensor([[0, 0, 0, 1]], dtype=torch.float64)
        K, viewmat = decomposed(entry, entry.affine("world_mat") @ torch.cat([scale, bottom]))
        K[:2, 2] += 0.5
        frames.append(Frame(name, image, mask, viewmat, K, size))
    return Listing(frames, points=points_beside(folder, frames), georeference=georeference)


def _cameras(path: Path) -> list[Entry]:
    """The matrices of each camera."""
    try:
        names = names_in_npz(path)
        count = max(1, sum(name.removeprefix("world_mat_").isdecimal() for name in names))
        wanted = [f"{kind}_{index}" for kind in ("world_mat", "scale_mat") for index in range(count)]
        if missing := [name for name in wanted if name not in names]:
            raise ValueError(f"has no {missing[0]}")
        found = load_npz(path, wanted)
    except ValueError as error:
        raise InputError(f"scene {path}: {error}; it must have world_mat_N and scale_mat_N of each photo") from error
    return [
        Entry(path, f"camera {index}", {kind: found[f"{kind}_{index}"].tolist() for kind in ("world_mat", "scale_mat")})
        for index in range(count)
    ]


def _masks(folder: Path, names: list[str], path: Path, wanted: Wanted) -> Iterator[Path | None]:
    """By their names where somebody says so or they are in `masks/`, else by their order in `mask/`."""
    if wanted.masks is not None or (folder / MASK_FOLDER).is_dir() or not (folder / _MASKS).is_dir():
        return (wanted.mask_of(folder, name, path) for name in names)
    found = photos_in(folder / _MASKS)
    if len(found) != len(names):
        raise InputError(
            f"scene {path}: has {len(names)} poses, but there are {len(found)} masks in {folder / _MASKS}, and their"
            f" order alone says which is whose; copy all of them there, or name a folder with {option('masks', ...)}"
        )
    return iter(found)


def _georeference(entry: Entry, scale: Float[Tensor, "3 4"]) -> Georeference | None:
    """Where the frame of the sphere lies in the world; None where that is turned, which it cannot say."""
    factor = float(torch.linalg.det(scale[:, :3]).clamp_min(0)) ** (1 / 3)
    turn = scale[:, :3] / factor
    within = 1e-9 <= factor <= 1e9 and float(scale[:, 3].abs().max()) < 1e15
    if not within or not torch.allclose(turn.T @ turn, torch.eye(3).double(), atol=_ALIKE):
        raise entry.wrong(
            "has a scale_mat that does not scale all directions alike, by a number from 1e-9 to 1e9; export the poses"
            " again"
        )
    if not torch.allclose(turn, torch.eye(3).double(), atol=_ALIKE):
        return None
    x, y, z = scale[:, 3].tolist()
    return Georeference((x, y, z), factor)
