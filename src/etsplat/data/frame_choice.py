"""Which frames of a video to find cameras for: the sharpest among neighbours, evenly spread over what moves."""

import itertools
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from etsplat.core.errors import InputError

LONGEST = 960
"""Pixels of the longer side of the frames that are measured: motion blur shows in it, and noise little."""

_MOTION_SIZE = 120
"""Motion is measured in blocks, so many along the longer side: what a hand does between frames is a part of a block."""

_STILL = 4e-4
"""Of the longer side: frames that differ by less differ by noise."""

_LEAST_STEP = 0.01
"""Of the longer side: frames with less motion between them show the same."""

_LEAST_MOTION = 0.05
"""Of the longer side: a video with less has no parallax to find cameras from."""

_MARGIN = 0.25
"""Of its part of the motion at either end, from which no frame is taken, so that two are half a part apart at least."""


@dataclass(frozen=True)
class Measured:
    """Frames of a video in order.

    Attributes:
        sharpness: of each, mean squared differences of grey levels two pixels apart.
        motion: from the frame before to each, mean over the picture in units of its longer side; 0 for the first.
    """

    sharpness: Float[np.ndarray, " N"]
    motion: Float[np.ndarray, " N"]


def measure_frames(frames: Iterable[UInt8[np.ndarray, "H W"]]) -> Measured:
    """Sharpness and motion of grey frames of one size, about `LONGEST` pixels long."""
    sharpness, motion = [], []
    before: Float[np.ndarray, "h w"] | None = None
    for frame in frames:
        levels = frame.astype(np.float32)
        across, down = levels[:, 2:] - levels[:, :-2], levels[2:] - levels[:-2]
        sharpness.append(float((across**2).mean() + (down**2).mean()))
        small = _blocks(levels)
        motion.append(0.0 if before is None or before.shape != small.shape else _motion(before, small))
        before = small
    return Measured(np.array(sharpness), np.array(motion))


def choose_frames(measured: Measured, count: int) -> list[int]:
    """Numbers of at most `count` frames, ascending: all motion is cut into equal parts, each gives its sharpest frame.

    Raises:
        InputError: hardly anything moves.
    """
    place = np.cumsum(np.where(measured.motion < _STILL, 0, measured.motion))
    whole = float(place[-1]) if len(place) else 0.0
    if whole < _LEAST_MOTION:
        raise InputError(
            f"the camera hardly moves in {len(place)} frames; walk around what is to be seen while recording"
        )
    edges = np.linspace(0, whole, max(1, min(count, int(whole / _LEAST_STEP))) + 1)
    margin = _MARGIN * (edges[1] - edges[0])
    chosen = []
    for low, high in itertools.pairwise(edges):
        inner = np.flatnonzero((place >= low + margin) & (place <= high - margin))
        candidates = inner if len(inner) else np.flatnonzero((place > low) & (place <= high))
        if len(candidates):
            chosen.append(int(candidates[measured.sharpness[candidates].argmax()]))
    return chosen


def _blocks(levels: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "h w"]:
    """Means of square blocks; what is left over at the ends is cut off."""
    side = max(1, max(levels.shape) // _MOTION_SIZE)
    height, width = (size // side for size in levels.shape)
    return levels[: height * side, : width * side].reshape(height, side, width, side).mean(axis=(1, 3))


def _motion(before: Float[np.ndarray, "h w"], after: Float[np.ndarray, "h w"]) -> float:
    """How far grey levels have moved, mean weighted by their gradients, after brightness is made equal.

    Along a gradient one sees, of motion at any angle to it, 2 / pi on average.
    """
    mean = (before - before.mean() + after - after.mean()) / 2
    change = (after - after.mean()) - (before - before.mean())
    down, across = np.gradient(mean)
    gradient = np.hypot(down, across)
    strength = float((gradient**2).sum())
    if strength == 0:
        return 0.0
    return np.pi / 2 * float((np.abs(change) * gradient).sum()) / strength / max(before.shape)
