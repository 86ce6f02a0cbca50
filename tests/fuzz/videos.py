"""Videos that are changed, and how they are read: as `etsplat data sfm` does, without choosing among their frames."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image

from etsplat.io.video_files import count_frames, grey_frames, write_video_frames
from helpers.videos import pan, write_video
from tests.fuzz.corpus import Files, made

_KINDS: dict[str, tuple[str, ...]] = {
    ".mp4": (),
    ".mkv": ("-g", "2"),
    ".avi": ("-c:v", "mjpeg", "-q:v", "5", "-pix_fmt", "yuvj420p"),
    ".mov": ("-c:v", "mjpeg", "-q:v", "5", "-pix_fmt", "yuvj420p"),
}
"""Containers, and what FFmpeg is told of their pictures: H.264 where nothing else is said."""

_WIDTH, _HEIGHT, _FRAMES, _LONGEST = 48, 32, 4, 32


def small_videos() -> list[Files]:
    """A few frames in each container."""
    frames = pan(range(0, 3 * _FRAMES, 3), width=_WIDTH, height=_HEIGHT)
    return [made(lambda at, s=s, o=o: write_video(at / f"input{s}", frames, *o)) for s, o in _KINDS.items()]


def read_video(path: Path) -> None:
    """Counts its frames, looks at them small, and writes the first whole.

    Raises:
        InputError: it is no video that can be read.
        AssertionError: what is accepted is not what is promised.
    """
    assert count_frames(path) > 0
    frames = list(grey_frames(path, _LONGEST))
    assert all(frame.dtype == np.uint8 and frame.ndim == 2 and max(frame.shape) <= _LONGEST for frame in frames)
    with TemporaryDirectory() as folder:
        (written,) = write_video_frames(path, [0], Path(folder), lambda done, of: None)
        with Image.open(written) as picture:
            picture.load()
            assert min(picture.size) > 0
