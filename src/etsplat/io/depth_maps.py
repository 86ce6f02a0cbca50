"""Depth maps on disk: 16-bit grey PNG, NPY, and EXR. Each pixel is the distance along the camera's optical axis.

A pixel whose depth nobody knows is 0: where a file has 0, NaN, infinity, or a number of at least 1e9 (Blender writes
1e10 where it sees nothing).
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.io.arrays import load_npy
from etsplat.io.images import MAX_PIXELS, open_image
from etsplat.io.paths import kind_of

DEPTH_SUFFIXES = (".png", ".npy", ".exr")
"""File name endings, lower case, of depth maps."""

INTEGER_UNIT = 0.001
"""Units of the capture in a step of files with integers that nobody says otherwise of: millimetres of metres."""

_NOTHING = 1e9
_NAMES = ("z", "v", "y", "d", "depth", "r")
"""What the channel of an EXR is called, behind the last dot, the likeliest first."""

_DENSEST = 2000
"""Pixels in a byte of EXR, at most: deflate makes 1032 bytes of one, half a float each."""


def load_depth(path: Path | str, unit: float | None = None) -> Float[Tensor, "H W"]:
    """Read a depth map.

    Args:
        path: a grey PNG of 16 bits, a NPY file of one (H, W) array of numbers, or an EXR, which needs OpenEXR.
        unit: units of the capture in a step of the file's numbers; None for 0.001 of integers and 1 of others.

    Returns:
        float32 in units of the capture, at least 0; 0 where the depth is not known.

    Raises:
        InputError: the file is missing, damaged, of another kind, has no such channel, or holds negative numbers.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"depth map {path}: no such file; check the path")
    numbers = _READERS[kind_of(path)](path) if kind_of(path) in _READERS else None
    if numbers is None:
        raise InputError(f"depth map {path}: not a kind that is read; convert it to 16-bit PNG, NPY or EXR")
    if unit is None:
        unit = INTEGER_UNIT if numbers.dtype.kind in "iu" else 1.0
    with np.errstate(all="ignore"):
        depth = numbers.astype(np.float64)
        depth[~np.isfinite(depth) | (depth >= _NOTHING)] = 0.0
        if (depth < 0).any():
            raise InputError(f"depth map {path}: holds negative numbers; write 0 where the depth is not known")
        scaled = (depth * unit).astype(np.float32)
    scaled[~np.isfinite(scaled)] = 0.0
    return torch.from_numpy(scaled)


def resize_depth(depth: Float[Tensor, "H W"], width: int, height: int) -> Float[Tensor, "H2 W2"]:
    """A depth map of another size, in which every depth is one that the map has: foreground and background never mix.

    Of the depths at nine places of a pixel it is the median of those that are known, the nearer of two. A pixel of
    which less than half is known is not known.
    """
    H, W = depth.shape
    if (width, height) == (W, H):
        return depth
    rows, columns = (
        (((torch.arange(3 * count, dtype=torch.float64) + 0.5) * size / (3 * count)).long()).clamp_max(size - 1)
        for count, size in ((height, H), (width, W))
    )
    places = depth[rows][:, columns].view(height, 3, width, 3).permute(0, 2, 1, 3).reshape(height, width, 9)
    known = (places > 0).sum(dim=-1)
    ordered = torch.where(places > 0, places, torch.inf).sort(dim=-1).values
    median = ordered.gather(-1, ((known - 1).clamp_min(0) // 2)[..., None])[..., 0]
    return torch.where(known >= 5, median, 0.0).contiguous()


def _png(path: Path) -> np.ndarray:
    with open_image(path) as image:
        if not image.mode.startswith("I"):
            raise InputError(f"depth map {path}: has {image.mode} pixels; write grey ones of 16 bits")
        try:
            return np.asarray(image).astype(np.int32)
        except Exception as error:  # Pillow's decoders signal damage with whatever their parsing runs into
            raise InputError(f"depth map {path}: damaged or cut short; write it again") from error


def _npy(path: Path) -> np.ndarray:
    try:
        numbers = load_npy(path)
    except ValueError as error:
        raise InputError(f"depth map {path}: {error}; write it again") from error
    sides = [side for side in numbers.shape if side != 1] if numbers.ndim == 3 else list(numbers.shape)
    if len(sides) != 2 or not 0 < numbers.size <= MAX_PIXELS:
        raise InputError(f"depth map {path}: has the shape {numbers.shape}; write one number for each pixel, (H, W)")
    return np.array(numbers).reshape(sides)


def _exr(path: Path) -> np.ndarray:
    library = _import()
    try:
        with library.File(str(path), separate_channels=True, header_only=True) as file:
            low, high = (np.asarray(corner, dtype=np.int64) for corner in file.header()["dataWindow"])
        width, height = (int(side) for side in high - low + 1)
        if not (0 < width * height <= MAX_PIXELS and width > 0 and width * height <= _DENSEST * path.stat().st_size):
            raise InputError(f"depth map {path}: damaged, cut short or too large; write it again")
        with library.File(str(path), separate_channels=True) as file:
            channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    except InputError:
        raise
    except Exception as error:  # what its C++ throws
        detail = (str(error).splitlines() or [type(error).__name__])[0][:100]
        raise InputError(f"depth map {path}: no EXR that can be read ({detail}); write it again") from error
    ranks = {name.rpartition(".")[2].lower(): name for name in reversed(channels)}
    name = next((ranks[end] for end in _NAMES if end in ranks), None)
    if len(channels) == 1:
        name = next(iter(channels))
    if name is None:
        raise InputError(f"depth map {path}: has the channels {', '.join(channels)[:60]}; call that of the depth Z")
    pixels = channels[name]
    if pixels.ndim != 2 or pixels.shape != (height, width) or pixels.dtype.kind not in "fiu":
        raise InputError(f"depth map {path}: its channel {name} is no plain picture; write it again")
    return pixels.astype(np.float32)  # also of integers: an EXR has no steps


def _import() -> Any:
    try:
        import OpenEXR
    except ImportError as error:
        raise InputError("depth maps in EXR need OpenEXR: pip install 'etsplat[depth]'") from error
    return OpenEXR


_READERS = {".png": _png, ".npy": _npy, ".exr": _exr}
