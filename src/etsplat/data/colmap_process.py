"""COLMAP in a process of its own: where it finds the disk full, it ends the process that it is in.

This module does not import torch, so that such a process starts soon.
"""

import contextlib
import multiprocessing
import os
import signal
import sqlite3
import threading
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

from etsplat.core.errors import InputError
from etsplat.core.processes import when_parent_ends

Progress = Callable[[str, int, int], None]
Result = TypeVar("Result")

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
        report: called here with what it reports there.

    Raises:
        RuntimeError: the process came to a sudden end.
        Exception: what `function` raised.
    """
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_serve, args=(sender, function, arguments), daemon=True)
    process.start()
    sender.close()  # so that the end of the other process ends the pipe
    try:
        while True:
            kind, value = receiver.recv()
            if kind == "result":
                return value
            if kind == "error":
                raise value
            if report is not None:
                report(*value)
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


def place_photos(
    report: Progress,
    photos: Path,
    names: list[str],
    work: Path,
    exhaustive: bool,
    one_camera: bool,
    max_size: int,
    threads: int,
) -> Path | None:
    """Structure from motion. The folder of the largest model within `work`, if there is one."""
    pycolmap = import_pycolmap()
    database = work / "database.db"
    mode = pycolmap.CameraMode.SINGLE if one_camera else pycolmap.CameraMode.AUTO
    options = pycolmap.FeatureExtractionOptions(max_image_size=max_size, num_threads=threads, use_gpu=False)
    with _polled(database, "keypoints", "Finding features", len(names), report):
        pycolmap.extract_features(
            database, photos, names, camera_mode=mode, extraction_options=options, device=pycolmap.Device.cpu
        )
    pairing: dict[str, Any] = {
        "matching_options": pycolmap.FeatureMatchingOptions(num_threads=threads, use_gpu=False),
        "device": pycolmap.Device.cpu,
    }
    if exhaustive:
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
    largest = max(models, key=lambda index: models[index].num_reg_images(), default=None)
    return None if largest is None else work / "models" / str(largest)


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


def undistort_images(report: Progress, model: Path, photos: Path, names: list[str], scene: Path, max_size: int) -> None:
    """Writes `names` of `photos` without distortion, and a model for them, into the folder `scene`."""
    pycolmap = import_pycolmap()
    options = pycolmap.UndistortCameraOptions(max_image_size=max_size)
    pycolmap.undistort_images(scene, model, photos, names, undistort_options=options)
