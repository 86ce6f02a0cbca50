"""Frames of video files, decoded by FFmpeg in a process of its own (imageio-ffmpeg, an extra)."""

import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np
from jaxtyping import UInt8

from etsplat.core.errors import InputError
from etsplat.io.images import MAX_PIXELS
from etsplat.io.videos import told_error

_CONTAINERS = "mov,matroska,webm,avi,mpeg,mpegts,asf,flv,ogg,m4v"
"""What is opened. Playlists are not: they name other files, and addresses."""

_JPEG_QUALITY = 2
"""FFmpeg's best that is of use; videos have lost more."""


def count_frames(path: Path) -> int:
    """About how many frames a video has; decodes none.

    Raises:
        InputError: imageio-ffmpeg is missing; no such file, empty, or no video.
    """
    if not path.is_file():
        raise InputError(f"video {path}: no such file; check the path")
    if path.stat().st_size == 0:
        raise InputError(f"video {path}: the file is empty; copy it again")
    count = 0
    with _ffmpeg(path, ["-c", "copy", "-progress", "pipe:1", "-f", "null", "-"]) as output:
        for line in output:
            name, _, value = line.decode(errors="replace").partition("=")
            if name == "frame" and value.strip().isdigit():
                count = int(value)
    if count == 0:
        raise InputError(f"video {path}: has no frames; copy it again")
    return count


def grey_frames(path: Path, longest: int) -> Iterator[UInt8[np.ndarray, "H W"]]:
    """All frames of a video in order, upright, grey, shrunk until no side is longer than `longest` pixels.

    Raises:
        InputError: as `count_frames`; or a frame is damaged, or none can be decoded.
    """
    count = 0
    fit = f"scale='min({longest},iw)':'min({longest},ih)':force_original_aspect_ratio=decrease:flags=area"
    output_as = ["-vf", f"{fit},format=gray", "-c:v", "pgm", "-f", "image2pipe", "-"]
    with _ffmpeg(path, [*_EVERY_FRAME, *output_as]) as output:
        while (header := output.readline()).strip() == b"P5":
            width, height = map(int, output.readline().split())
            output.readline()  # the largest value, 255
            data = output.read(width * height)
            if len(data) < width * height:
                break
            count += 1
            yield np.frombuffer(data, np.uint8).reshape(height, width)
        if header:
            output.read()
    if count == 0:  # which FFmpeg does not mind where what they begin from is missing
        raise InputError(f"video {path}: none of its frames can be decoded; convert it to MP4 anew")


def write_video_frames(
    path: Path, numbers: Sequence[int], folder: Path, report: Callable[[int, int], None]
) -> list[Path]:
    """Writes frames of a video as JPEG files, upright and in full size, named by their numbers.

    Args:
        path: of the video.
        numbers: of frames, from 0, ascending.
        folder: for the files.
        report: called with (frames written, of how many).

    Raises:
        InputError: as `grey_frames`; or frames change in size on the way, from where on FFmpeg's numbers begin again.
        OSError: the files cannot be written.
    """
    chosen = "+".join(f"eq(n,{number})" for number in numbers)
    output_as = ["-vf", f"select='{chosen}'", "-c:v", "mjpeg", "-q:v", str(_JPEG_QUALITY), "-pix_fmt", "yuvj420p"]
    files = [folder / f"frame_{number:06d}.jpg" for number in numbers]
    with _ffmpeg(path, [*_EVERY_FRAME, *output_as, "-progress", "pipe:1", str(folder / "new_%06d.jpg")]) as output:
        for line in output:
            name, _, value = line.decode(errors="replace").partition("=")
            if name == "frame" and value.strip().isdigit():
                report(min(int(value), len(files)), len(files))
    written = sorted(folder.glob("new_*.jpg"))
    if len(written) != len(files):
        raise InputError(f"video {path}: its pictures change in size on the way; convert it to MP4 anew, in one size")
    for source, target in zip(written, files, strict=True):
        source.rename(target)
    return files


_EVERY_FRAME = ["-fps_mode", "passthrough", "-an", "-sn"]
"""None twice or left out to keep a pace: phones write as many a second as the light allows."""


@contextmanager
def _ffmpeg(path: Path, arguments: list[str]) -> Iterator[IO[bytes]]:
    """FFmpeg's standard output while it reads a video; it ends with the block.

    Raises:
        InputError: imageio-ffmpeg is missing; or FFmpeg finds something wrong with the video.
        OSError: what it writes does not fit on the disk.
    """
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise InputError(
            "reading videos needs imageio-ffmpeg: pip install 'etsplat[video]', or hand in a folder of photos"
        ) from error
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-nostdin", "-v", "error", "-xerror", "-y"]
    command += ["-protocol_whitelist", "file", "-format_whitelist", _CONTAINERS, "-max_pixels", str(MAX_PIXELS)]
    # The protocol stands there, as a name may have a colon.
    command += ["-i", f"file:{path.resolve()}", "-map", "0:v:0", *arguments]
    with tempfile.TemporaryFile() as complaints:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=complaints)
        assert process.stdout is not None
        try:
            yield process.stdout
            process.stdout.read()
            failed = process.wait() != 0
        finally:
            process.kill()
            process.wait()
            process.stdout.close()
        if failed:
            complaints.seek(0)
            told = complaints.read().decode(errors="replace")
            if (error := told_error(told)) is not None:
                raise error
            raise InputError(f"video {path}: cannot be read ({_reason(told)}); convert it to MP4 anew")


def _reason(complaints: str) -> str:
    """FFmpeg's first complaint, which the others follow from, without the part of it that complains."""
    if "matches no streams" in complaints:
        return "no pictures in it"
    lines = [line.strip() for line in complaints.splitlines() if line.strip()]
    first = lines[0] if lines else "FFmpeg failed"
    return "".join(c for c in first.rpartition("] ")[2] if c.isprintable())[:160]
