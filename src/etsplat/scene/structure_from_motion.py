"""Cameras for a folder of photos: structure from motion with pycolmap (an extra), on the CPU."""

import contextlib
import os
import sqlite3
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from etsplat.core.errors import InputError
from etsplat.io.images import IMAGE_SUFFIXES, image_size
from etsplat.scene.undistortion import check_new, check_space, import_pycolmap, undistort_model, working_folder

Matching = Literal["auto", "exhaustive", "sequential"]
Progress = Callable[[str, int, int], None]

EXHAUSTIVE_UP_TO = 120
"""With matching "auto", every pair of so many photos is compared; of more, only those near in order of names."""

NEIGHBOURS = 15
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
    check_new(out)
    files = [photos / name for name in names]
    check_space(out, files, BYTES_PER_PHOTO * len(files))
    report = progress or (lambda phase, done, total: None)
    with working_folder(out) as work:
        model = _reconstruct(pycolmap, photos, names, work, matching, max_size, threads or -1, report)
        placed = sorted(image.name for image in model.images.values() if image.has_pose)
        if len(placed) < max(LEAST_COUNT, LEAST_SHARE * len(names)):
            raise InputError(_too_few(photos, len(placed), len(names)))
        report("Removing lens distortion", 0, 0)
        undistort_model(pycolmap, model, photos, placed, work, max_size)
        os.replace(work / "scene", out)
    unplaced = [name for name in names if name not in set(placed)]
    return Placement(out, placed, unplaced, len(model.points3D))


def _reconstruct(
    pycolmap: Any,
    photos: Path,
    names: list[str],
    work: Path,
    matching: Matching,
    max_size: int,
    threads: int,
    report: Progress,
) -> Any:
    """The largest model, or an empty one."""
    database = work / "database.db"
    one_size = len({image_size(photos / name) for name in names}) == 1
    mode = pycolmap.CameraMode.SINGLE if one_size else pycolmap.CameraMode.AUTO
    options = pycolmap.FeatureExtractionOptions(max_image_size=max_size, num_threads=threads, use_gpu=False)
    with _polled(database, "keypoints", "Finding features", len(names), report):
        pycolmap.extract_features(
            database, photos, names, camera_mode=mode, extraction_options=options, device=pycolmap.Device.cpu
        )
    pairing: dict[str, Any] = {
        "matching_options": pycolmap.FeatureMatchingOptions(num_threads=threads, use_gpu=False),
        "device": pycolmap.Device.cpu,
    }
    if matching == "exhaustive" or (matching == "auto" and len(names) <= EXHAUSTIVE_UP_TO):
        pairs, match = len(names) * (len(names) - 1) // 2, pycolmap.match_exhaustive
    else:
        pairs, match = len(names) * NEIGHBOURS, pycolmap.match_sequential
        pairing["pairing_options"] = pycolmap.SequentialPairingOptions(overlap=NEIGHBOURS, loop_detection=False)
    with _polled(database, "matches", "Comparing photos", pairs, report):
        match(database, **pairing)
    count = 0

    def placed_one() -> None:
        nonlocal count
        count += 1
        report("Placing cameras", min(count + 1, len(names)), len(names))

    report("Placing cameras", 0, len(names))
    (work / "models").mkdir()
    models = pycolmap.incremental_mapping(
        database,
        photos,
        work / "models",
        options=pycolmap.IncrementalPipelineOptions(num_threads=threads),
        next_image_callback=placed_one,
    )
    return max(models.values(), key=lambda model: model.num_reg_images(), default=pycolmap.Reconstruction())


@contextlib.contextmanager
def _polled(database: Path, table: str, phase: str, total: int, report: Progress) -> Iterator[None]:
    """Reports rows of a table of COLMAP's database every half second: its functions tell nothing themselves."""
    finished = threading.Event()

    def poll() -> None:
        while not finished.wait(0.5):
            # The database may not be there yet, or be locked: then the next poll tells.
            with contextlib.suppress(sqlite3.Error):
                connection = sqlite3.connect(f"file:{database}?mode=ro", uri=True, timeout=0.1)
                try:
                    rows = connection.execute(f"SELECT count(*) FROM {table}").fetchone()[0]
                finally:
                    connection.close()
                report(phase, min(rows, total), total)

    report(phase, 0, total)
    thread = threading.Thread(target=poll, daemon=True)
    thread.start()
    try:
        yield
    finally:
        finished.set()
        thread.join()


def _photo_names(photos: Path) -> list[str]:
    if not photos.is_dir():
        raise InputError(f"photos {photos}: no such folder; check the path")
    names = sorted(path.name for path in photos.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)
    if len(names) < LEAST_COUNT:
        raise InputError(f"photos {photos}: {len(names)} JPEG or PNG files; at least 3 are needed, better 20 or more")
    return names


def _too_few(photos: Path, placed: int, count: int) -> str:
    return (
        f"photos {photos}: only {placed} of {count} could be placed in one scene; take more photos, each overlapping"
        " its neighbours by two thirds, sharp, of something that stands still, walking around it rather than turning"
    )
