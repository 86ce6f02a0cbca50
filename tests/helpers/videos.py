"""Small videos of something that moves."""

import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest


def texture(width: int, height: int, seed: int = 0) -> np.ndarray:
    """(height, width, 3) uint8: soft noise of several sizes, sharp enough that blur shows."""
    rng, grey = np.random.default_rng(seed), np.zeros((height, width))
    for size in (4, 16):
        small = rng.normal(size=(-(-height // size), -(-width // size)))
        grey += size**0.5 * np.kron(small, np.ones((size, size)))[:height, :width]
    grey = (grey - grey.min()) / np.ptp(grey)
    return np.repeat((255 * grey).astype(np.uint8)[..., None], 3, axis=2)


def pan(places: Sequence[float], blurred: Sequence[int] = (), width: int = 160, height: int = 120) -> list[np.ndarray]:
    """Frames of a camera that looks at so many pixels to the right of where it began; some are blurred."""
    wall = texture(width + int(max(places)) + 16, height)
    frames = []
    for index, place in enumerate(places):
        looks = [wall[:, int(place) + step : int(place) + step + width] for step in range(9 if index in blurred else 1)]
        frames.append(np.mean(looks, axis=0).astype(np.uint8))
    return frames


def write_video(path: Path, frames: Sequence[np.ndarray], *options: str) -> None:
    """Writes frames as H.264; `options` of FFmpeg come before the output."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    height, width = frames[0].shape[:2]
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", "30", "-i", "-"]
    encode = ["-c:v", "libx264", "-preset", "ultrafast", "-crf", "8", "-pix_fmt", "yuv420p", "-threads", "1", *options]
    command = [ffmpeg, "-y", "-loglevel", "error", *source, *encode, str(path)]
    subprocess.run(command, input=b"".join(frame.tobytes() for frame in frames), check=True)


def rewrite_video(source: Path, path: Path, before: Sequence[str] = (), after: Sequence[str] = ("-c", "copy")) -> None:
    """Writes a video anew with options of FFmpeg for its input and its output."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    command = [ffmpeg, "-y", "-loglevel", "error", *before, "-i", str(source), *after, str(path)]
    subprocess.run(command, check=True)
