"""COLMAP in a process of its own: where it finds the disk full, it ends the process that it is in.

This module does not import torch, so that such a process starts soon.
"""

import contextlib
import multiprocessing
import os
import signal
import sqlite3
from collections.abc import Callable
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal, TypeVar

from etsplat.core.errors import InputError
from etsplat.core.processes import when_parent_ends

Progress = Callable[[str, int, int], None]
"""Called with (phase, done, of how many)."""

Report = Callable[..., None]
"""The same within the process of its own; a fourth argument is what counts from then on, asked in the other process."""

_POLL_SECONDS = 0.5

Result = TypeVar("Result")

Mapper = Literal["incremental", "global"]
"""Cameras one after the other; or all at once (GLOMAP)."""

LEAST_PLACED = 0.9
"""Where fewer of the photos are placed, one photo after the other, other beginnings are tried."""

SMALL_ANGLE = 4.0
"""Degrees between the rays of the two photos that a second beginning is content with.

COLMAP wants 16, by a focal length that is at first a guess: a camera that hardly moves never shows as much."""

LEAST_IN_ORDER = 0.5
"""Where fewer are placed by comparing those near in order of names, that order says little, as of photos by many
people: every pair is compared."""

NEIGHBOURS = 15
"""Photos on either side, in order of names, that one is compared with where not every pair is."""


def import_pycolmap() -> Any:
    """The module, told to be quiet.

    Raises:
        InputError: it is not installed.
    """
    try:
        import pycolmap
    except ImportError as error:
        raise InputError(
            "structure from motion and undistortion need pycolmap: pip install 'etsplat[sfm]' (or use COLMAP itself)"
        ) from error
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    return pycolmap


def run_apart(function: Callable[..., Result], *arguments: Any, report: Progress | None = None) -> Result:
    """Calls `function(report, *arguments)` in a new process, which ends at once with Ctrl-C or with this process.

    Args:
        function: of a module; it, its arguments and its result can be pickled.
        arguments: all but the first.
        report: called here with what it reports there, and with what is counted here meanwhile.

    Raises:
        RuntimeError: the process came to a sudden end.
        Exception: what `function` raised.
    """
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_serve, args=(sender, function, arguments), daemon=True)
    process.start()
    sender.close()  # so that the end of the other process ends the pipe
    phase, total, count = "", 0, None
    try:
        while True:
            if not receiver.poll(_POLL_SECONDS):
                # What is counted may not be there yet, or be locked: then the next poll tells.
                with contextlib.suppress(sqlite3.Error, OSError):
                    if report is not None and count is not None:
                        report(phase, min(count(), total), total)
                continue
            kind, value = receiver.recv()
            if kind == "result":
                return value
            if kind == "error":
                raise value
            phase, done, total, *counts = value
            count = counts[0] if counts else None
            if report is not None:
                report(phase, done, total)
    except EOFError as error:
        process.join()
        raise RuntimeError(f"a sudden end, exit status {process.exitcode}") from error
    finally:
        process.kill()
        process.join()


def _serve(sender: Connection, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    import_pycolmap()
    for number in (signal.SIGABRT, signal.SIGSEGV, signal.SIGBUS):  # its handlers print stack traces, and may hang
        signal.signal(number, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # whoever waits for the result ends this process
    when_parent_ends(lambda: os._exit(1))
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # nobody reads what the libraries below COLMAP say at their end
    try:
        answer = ("result", function(lambda *state: sender.send(("progress", state)), *arguments))
    except Exception as error:
        answer = ("error", error)
    sender.send(answer)


@dataclass(frozen=True)
class Rows:
    """Counts the rows of a table of COLMAP's database.

    Never in COLMAP's own process: another SQLite in it takes the locks for its own, cuts the file that both have in
    memory, and the next access ends the process.
    """

    database: Path
    table: str

    def __call__(self) -> int:
        """Raises sqlite3.Error where it cannot be read just now."""
        connection = sqlite3.connect(f"{self.database.resolve().as_uri()}?mode=ro", uri=True, timeout=0.1)
        try:
            return connection.execute(f"SELECT count(*) FROM {self.table}").fetchone()[0]
        finally:
            connection.close()


@dataclass(frozen=True)
class Files:
    """Counts the files in a folder and its subfolders."""

    folder: Path

    def __call__(self) -> int:
        """Raises OSError where it cannot be read just now."""
        return sum(path.is_file() for path in self.folder.rglob("*"))


@dataclass(frozen=True)
class Job:
    """What structure from motion is to do.

    Attributes:
        photos: folder of the photos.
        cameras: names of photos in it, those with one camera together.
        work: folder for the database and the models.
        exhaustive: whether every pair is compared; else those near in order of names.
        widens: whether every pair is where these say too little.
        mapper: cameras one after the other, or all at once.
        max_size: features are looked for in pictures that are no longer than so many pixels.
        threads: -1 for all cores.
        masks: folder with a PNG file for each photo, black where no features are to be looked for; None for none.
    """

    photos: Path
    cameras: list[list[str]]
    work: Path
    exhaustive: bool
    widens: bool
    mapper: Mapper
    max_size: int
    threads: int
    masks: Path | None

    @property
    def names(self) -> list[str]:
        """Of all photos, in order."""
        return sorted(name for camera in self.cameras for name in camera)


def place_photos(report: Report, job: Job) -> Path | None:
    """Structure from motion. The folder of the largest model within `job.work`, if there is one."""
    pycolmap = import_pycolmap()
    database = job.work / "database.db"
    _find_features(pycolmap, database, job, report)
    place = _place_all if job.mapper == "global" else _place_one_by_one
    _compare(pycolmap, database, job, report)
    models = place(pycolmap, database, job, _made(job.work / "models"), report)
    if job.widens and not job.exhaustive and _most_placed(models) < LEAST_IN_ORDER * len(job.names):
        _compare(pycolmap, database, replace(job, exhaustive=True), report)
        models += place(pycolmap, database, job, _made(job.work / "models_of_all_pairs"), report)
    largest = max(models, key=_placed, default=None)
    if largest is None:
        return None
    largest.write(_made(job.work / "largest"))
    return job.work / "largest"


def _placed(model: Any) -> int:
    return model.num_reg_images()


def _most_placed(models: list[Any]) -> int:
    return max(map(_placed, models), default=0)


def _find_features(pycolmap: Any, database: Path, job: Job, report: Report) -> None:
    pycolmap.Database.open(database).close()  # which makes it
    for names in job.cameras:
        # The first photo's EXIF gives the focal length to start from.
        pycolmap.import_images(database, job.photos, pycolmap.CameraMode.SINGLE, names)
    report("Finding features", 0, len(job.names), Rows(database, "keypoints"))
    pycolmap.extract_features(
        database,
        job.photos,
        job.names,
        reader_options=pycolmap.ImageReaderOptions(**({} if job.masks is None else {"mask_path": job.masks})),
        extraction_options=pycolmap.FeatureExtractionOptions(
            max_image_size=job.max_size, num_threads=job.threads, use_gpu=False
        ),
        device=pycolmap.Device.cpu,
    )
    report("Finding features", len(job.names), len(job.names))


def _compare(pycolmap: Any, database: Path, job: Job, report: Report) -> None:
    count = len(job.names)
    pairing: dict[str, Any] = {
        "matching_options": pycolmap.FeatureMatchingOptions(num_threads=job.threads, use_gpu=False),
        "device": pycolmap.Device.cpu,
    }
    if job.exhaustive:
        pairs, match = count * (count - 1) // 2, pycolmap.match_exhaustive
    else:
        near = min(NEIGHBOURS, count - 1)
        pairs, match = near * count - near * (near + 1) // 2, pycolmap.match_sequential
        pairing["pairing_options"] = pycolmap.SequentialPairingOptions(overlap=NEIGHBOURS, loop_detection=False)
    report("Comparing photos", 0, pairs, Rows(database, "matches"))
    match(database, **pairing)
    report("Comparing photos", pairs, pairs)


def _place_one_by_one(pycolmap: Any, database: Path, job: Job, folder: Path, report: Report) -> list[Any]:
    """Models of all beginnings that were tried: with other angles, at last with focal lengths from pairs of photos."""
    count, models = len(job.names), []
    for attempt, (angle, calibrated) in enumerate(((None, False), (SMALL_ANGLE, False), (SMALL_ANGLE, True))):
        if calibrated and not _calibrate(pycolmap, database):
            break
        options = pycolmap.IncrementalPipelineOptions(num_threads=job.threads)
        if angle is not None:
            options.mapper.init_min_tri_angle = angle
        progress = _Placing(report, count)
        models += pycolmap.incremental_mapping(
            database, job.photos, _made(folder / str(attempt)), options=options, next_image_callback=progress
        ).values()
        if _most_placed(models) >= LEAST_PLACED * count:
            break
    return models


class _Placing:
    """Is called for each photo that is placed, but the first."""

    def __init__(self, report: Report, count: int) -> None:
        self.report, self.count, self.placed = report, count, 1
        report("Placing cameras", 0, count)

    def __call__(self) -> None:
        self.placed += 1
        self.report("Placing cameras", min(self.placed, self.count), self.count)


def _place_all(pycolmap: Any, database: Path, job: Job, folder: Path, report: Report) -> list[Any]:
    report("Placing all cameras at once", 0, 0)
    _calibrate(pycolmap, database)
    options = pycolmap.GlobalPipelineOptions(num_threads=job.threads)
    return list(pycolmap.global_mapping(database, job.photos, folder, options).values())


def _calibrate(pycolmap: Any, database: Path) -> bool:
    """Focal lengths that no photo tells, from pairs of photos; whether there are such."""
    if all(camera.has_prior_focal_length for camera in _cameras(pycolmap, database)):
        return False
    pycolmap.calibrate_view_graph(database)
    return True


def _cameras(pycolmap: Any, database: Path) -> list[Any]:
    opened = pycolmap.Database.open(database)
    try:
        return opened.read_all_cameras()
    finally:
        opened.close()


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder


def undistort_images(report: Report, model: Path, photos: Path, names: list[str], scene: Path, max_size: int) -> None:
    """Writes `names` of `photos` without distortion, and a model for them, into the folder `scene`."""
    pycolmap = import_pycolmap()
    options = pycolmap.UndistortCameraOptions(max_image_size=max_size)
    report("Removing lens distortion", 0, len(names), Files(scene / "images"))
    pycolmap.undistort_images(scene, model, photos, names, undistort_options=options)
    report("Removing lens distortion", len(names), len(names))
