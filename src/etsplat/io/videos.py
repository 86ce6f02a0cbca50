"""MP4 files, through imageio-ffmpeg (an extra)."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.io.atomic import atomic_write
from etsplat.io.images import to_8_bit


class VideoSink(Protocol):
    """What takes the frames of a video."""

    def __call__(self, frame: Float[Tensor, "H W 3"]) -> None:
        """Appends a frame, values in [0, 1]; an odd last row or column is cut off, as H.264 has none."""
        ...


@contextmanager
def open_video(path: Path | str, fps: int) -> Iterator[VideoSink]:
    """Write a video in H.264; all frames have the size of the first. The file appears when the block succeeds.

    Raises:
        InputError: imageio-ffmpeg is missing; the file cannot be written.
    """
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise InputError(
            "MP4 needs imageio-ffmpeg: pip install 'etsplat[video]', or write single frames with --format frames"
        ) from error
    writer: Any = None
    with atomic_write(path) as temporary:

        def append(frame: Float[Tensor, "H W 3"]) -> None:
            nonlocal writer
            height, width = (size // 2 * 2 for size in frame.shape[:2])
            pixels = np.ascontiguousarray(to_8_bit(frame[:height, :width]).cpu().numpy())
            if writer is None:
                writer = imageio_ffmpeg.write_frames(
                    str(temporary), (width, height), fps=fps, quality=8, macro_block_size=2, ffmpeg_log_level="error"
                )
                writer.send(None)
            writer.send(pixels)

        try:
            yield append
        finally:
            if writer is not None:
                writer.close()
