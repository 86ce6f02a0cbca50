"""A video becomes a folder of photos: its chosen frames, beside a record of where they come from."""

import json
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from etsplat.core.errors import InputError
from etsplat.data.frame_choice import LONGEST, choose_frames, measure_frames
from etsplat.io.json_text import parse_json
from etsplat.io.locks import scratch_folder
from etsplat.io.video_files import count_frames, grey_frames, write_video_frames

FRAMES = "frames"
"""The folder's name in that of the scene."""

RECORD = "frames.json"

LEAST_FRAMES = 3


def frames_of_video(video: Path, folder: Path, count: int, report: Callable[[str, int, int], None]) -> Path:
    """Chooses frames and writes them into a folder, unless they are there already.

    Args:
        video: the file.
        folder: appears when all is written.
        count: frames that are asked for.
        report: called with (phase, done, of how many).

    Returns:
        The folder.

    Raises:
        InputError: `count` is below three; the video cannot be read, or hardly shows anything moving; the folder holds
            other frames than these.
        OSError: it cannot be written.
    """
    if count < LEAST_FRAMES:
        raise InputError(f"frames: is {count}; at least {LEAST_FRAMES} are needed, better 60 or more")
    total = count_frames(video)
    origin = {"video": video.name, "bytes": video.stat().st_size, "asked_for": count}
    if folder.is_dir():
        _check_origin(folder, origin)
        return folder
    measured = measure_frames(_told(grey_frames(video, LONGEST), total, report))
    try:
        numbers = choose_frames(measured, count)
    except InputError as error:
        raise InputError(f"video {video}: {error}") from error
    folder.parent.mkdir(parents=True, exist_ok=True)
    with scratch_folder(folder) as work:
        made = work / "made"
        made.mkdir()
        report("Writing frames", 0, len(numbers))
        write_video_frames(video, numbers, made, lambda done, of: report("Writing frames", done, of))
        record = {**origin, "numbers": numbers, "sharpness": [round(float(measured.sharpness[n]), 1) for n in numbers]}
        (made / RECORD).write_text(json.dumps(record))
        os.replace(made, folder)
    return folder


def _check_origin(folder: Path, origin: dict[str, str | int]) -> None:
    """Raises InputError where frames in a folder are not those that would be written there."""
    try:
        record = parse_json((folder / RECORD).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        record = None
    if not isinstance(record, dict) or any(record.get(key) != value for key, value in origin.items()):
        raise InputError(f"{folder}: holds frames of another video or another number of them; choose another folder")


def _told(frames: Iterator, total: int, report: Callable[[str, int, int], None]) -> Iterable:
    for done, frame in enumerate(frames):
        report("Reading the video", min(done, total), total)
        yield frame
