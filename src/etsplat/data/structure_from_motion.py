"""Cameras for a folder of photos: structure from motion with pycolmap (an extra), on the CPU."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from etsplat.core.errors import InputError
from etsplat.data.colmap_process import Progress, import_pycolmap, place_photos, run_apart
from etsplat.data.undistortion import check_output, check_space, undistort_model, working_folder
from etsplat.io.images import IMAGE_SUFFIXES, image_size
from etsplat.io.paths import kind_of, path_remedy

Matching = Literal["auto", "exhaustive", "sequential"]

EXHAUSTIVE_UP_TO = 120
"""With matching "auto", every pair of so many photos is compared; of more, only those near in order of names."""

LEAST_SHARE = 0.25
"""If fewer of the photos can be placed, something is wrong with them, and there is no scene."""
LEAST_COUNT = 3
BYTES_PER_PHOTO = 3 << 20
"""What COLMAP writes down of a photo at most: 8,192 features of 152 bytes, and its matches."""


@dataclass(frozen=True)
class Placement:
    """What structure from motion found.

    Attributes:
        scene: folder with images/ and sparse/0/, undistorted.
        placed: names of the photos with a camera.
        unplaced: names of those without.
        points: how many points were triangulated.
    """

    scene: Path
    placed: list[str]
    unplaced: list[str]
    points: int


def find_cameras(
    photos: Path | str,
    out: Path | str,
    *,
    matching: Matching = "auto",
    max_size: int = 1600,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Placement:
    """Find where photos were taken from, and write an undistorted COLMAP scene.

    Args:
        photos: folder of JPEG or PNG files, of one camera with one lens setting at best.
        out: folder of the scene; must not exist or be empty.
        matching: which photos are compared with each other.
        max_size: longer sides are shrunk to this many pixels, for finding features and in the scene.
        threads: None for all cores.
        progress: called with (phase, done, of how many).

    Raises:
        InputError: pycolmap is missing; too few photos; too few of them could be placed; `out` cannot be used.
    """
    pycolmap = import_pycolmap()
    photos, out = Path(photos), Path(out)
    names = _photo_names(photos)
    check_output(out, max_size)
    files = [photos / name for name in names]
    check_space(out, files, BYTES_PER_PHOTO * len(files))
    report = progress or (lambda phase, done, total: None)
    exhaustive = matching == "exhaustive" or (matching == "auto" and len(names) <= EXHAUSTIVE_UP_TO)
    one_camera = len({image_size(file) for file in files}) == 1
    with working_folder(out) as work:
        found = run_apart(
            place_photos, photos, names, work, exhaustive, one_camera, max_size, threads or -1, report=report
        )
        model = pycolmap.Reconstruction() if found is None else pycolmap.Reconstruction(found)
        placed = sorted(image.name for image in model.images.values() if image.has_pose)
        if len(placed) < max(LEAST_COUNT, LEAST_SHARE * len(names)):
            raise InputError(_too_few(photos, len(placed), len(names)))
        report("Removing lens distortion", 0, 0)
        undistort_model(model, photos, placed, work, max_size)
        os.replace(work / "scene", out)
    unplaced = [name for name in names if name not in set(placed)]
    return Placement(out, placed, unplaced, len(model.points3D))


def _photo_names(photos: Path) -> list[str]:
    if not photos.is_dir():
        raise InputError(f"photos {photos}: no such folder; {path_remedy(photos)}")
    names = sorted(path.name for path in photos.iterdir() if kind_of(path) in IMAGE_SUFFIXES)
    if len(names) < LEAST_COUNT:
        raise InputError(f"photos {photos}: {len(names)} JPEG or PNG files; at least 3 are needed, better 20 or more")
    return names


def _too_few(photos: Path, placed: int, count: int) -> str:
    return (
        f"photos {photos}: only {placed} of {count} could be placed in one scene; take more photos, each overlapping"
        " its neighbours by two thirds, sharp, of something that stands still, walking around it rather than turning"
    )
