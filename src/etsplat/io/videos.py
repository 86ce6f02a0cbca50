"""MP4 files, through imageio-ffmpeg (an extra)."""

import errno
import os
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.core.spelling import either
from etsplat.core.validation import check_above, check_floating, check_memory
from etsplat.io.atomic import atomic_write, write_error
from etsplat.io.images import to_8_bit
from etsplat.io.paths import given_path, kind_of

VIDEO_SUFFIXES = (".mp4", ".mov", ".mkv", ".avi")
"""Files that hold H.264."""


class VideoSink(Protocol):
    """What takes the frames of a video."""

    def __call__(self, frame: Float[Tensor, "H W 3"]) -> None:
        """Appends a frame, values in [0, 1]; an odd last row or column is cut off, as H.264 has none."""
        ...


@contextmanager
def open_video(path: Path | str, fps: float) -> Iterator[VideoSink]:
    """Write a video in H.264; all frames have the size of the first. The file appears when the block succeeds.

    Args:
        path: ends in .mp4, .mov, .mkv or .avi, in a folder that there is.
        fps: frames per second.

    Yields:
        A function that appends a frame: (H, W, 3) of floating-point numbers in [0, 1] (others are clamped), at least
        2 pixels high and wide.

    Raises:
        ValueError: another suffix; a rate that is no number above 0; a frame of another shape or kind, or with values
            that are not finite; no frame at all.
        InputError: imageio-ffmpeg is missing; the file cannot be written.

    Example:
        >>> with etsplat.open_video("fade.mp4", fps=24) as append:
        ...     for value in torch.linspace(0, 1, 12):
        ...         append(value.expand(32, 48, 3))
    """
    path = given_path("path", path)
    if kind_of(path) not in VIDEO_SUFFIXES:
        raise ValueError(f"path: expected one of the suffixes {', '.join(VIDEO_SUFFIXES)}, got {path.name}")
    check_above("fps", fps)
    try:
        import imageio_ffmpeg
    except ImportError as error:
        frames = either("--format frames", "etsplat.save_image")
        raise InputError(
            f"MP4 needs imageio-ffmpeg: pip install 'etsplat[video]', or write single frames with {frames}"
        ) from error
    if not path.parent.is_dir():
        raise write_error(path, FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT)))
    encoder: subprocess.Popen[bytes] | None = None
    first: tuple[int, ...] | None = None
    with atomic_write(path) as temporary, tempfile.TemporaryFile() as complaints:

        def append(frame: Float[Tensor, "H W 3"]) -> None:
            nonlocal encoder, first
            first = _check_frame(frame, first)
            height, width = (size // 2 * 2 for size in frame.shape[:2])
            if encoder is None:
                command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", "-f", "rawvideo"]
                command += ["-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(float(fps)), "-i", "-"]
                command += ["-c:v", "libx264", "-crf", "10", "-pix_fmt", "yuv420p", str(temporary)]
                encoder = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=complaints)
            assert encoder.stdin is not None
            with suppress(BrokenPipeError):  # it has given up: why is told at the end
                encoder.stdin.write(np.ascontiguousarray(to_8_bit(frame[:height, :width]).cpu().numpy()).tobytes())

        try:
            yield append
        finally:
            if encoder is not None:
                with suppress(BrokenPipeError):
                    encoder.communicate()  # ends its input and waits
        if encoder is None:
            raise ValueError("frames: expected at least one, got none")
        if encoder.returncode != 0:
            complaints.seek(0)
            raise _error(complaints.read().decode(errors="replace"))


def _check_frame(frame: Tensor, first: tuple[int, ...] | None) -> tuple[int, ...]:
    """The shape of a frame, which is that of the first one."""
    check_memory("frame", frame)
    check_floating("frame", frame)
    shape = tuple(frame.shape)
    if first is not None and shape != first:
        raise ValueError(f"frame: expected shape {first} like the first one, got {shape}")
    if len(shape) != 3 or shape[2] != 3 or min(shape) < 2:
        raise ValueError(f"frame: expected shape (H, W, 3), at least 2 pixels high and wide, got {shape}")
    return shape


def _error(complaints: str) -> OSError:
    """What the encoder said."""
    said = complaints.strip().splitlines()
    return told_error(complaints) or OSError(said[-1] if said else "the encoder failed")


def told_error(complaints: str) -> OSError | None:
    """The system's error that FFmpeg's complaints tell of, if it is that a disk is full or the like."""
    numbers = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    return next((OSError(n, os.strerror(n)) for n in numbers if os.strerror(n) in complaints), None)
