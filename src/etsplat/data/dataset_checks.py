"""What is made of the fields of a data set that is built in memory, and which are refused."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.core.validation import check_finite, check_floating, check_shape, shown, whole_number

_ROTATION = 0.01
"""How far R R^T may be from the identity: poses are written down with few digits."""

_ABOVE = 2 / 255
"""So much colours may be above their alpha: what rounding and resampling leave."""

_SKEW, _AWAY = 1e-4, 1e-6
"""How far a matrix of intrinsics may be from that of a pinhole, in focal lengths and in its last row: what rounding
leaves. It is taken out."""

_BRIGHTEST = 4.0
"""Exposed photos may be brighter than 1; what is brighter than this is not in [0, 1] at all."""

_INDICES_OF_FLAGS = ": of a mask of all views pass the indices, torch.tensor(mask).nonzero().flatten()"


def checked_pixels(name: str, pixels: Any) -> Tensor:
    """A photo as it is, without the graph of what it may have been drawn by.

    Raises:
        ValueError: it is no (H, W, 3 or 4) tensor of bytes or of finite float32 in [0, 1].
    """
    check_shape(name, pixels, ("H", "W", 3), ("H", "W", 4))
    if pixels.dtype not in (torch.uint8, torch.float32):
        raise ValueError(f"{name} must be uint8 or float32, got {pixels.dtype}")
    if pixels.dtype == torch.float32 and pixels.numel():
        low, high = (float(value) for value in torch.aminmax(pixels.detach()))
        if not (low >= -_BRIGHTEST and high <= _BRIGHTEST):  # NaN is neither
            raise ValueError(f"{name} must be in [0, 1], got {low:.4g} to {high:.4g}: bytes are uint8")
    return pixels.detach()


def is_straight(pixels: Tensor) -> bool:
    """Whether colours are above their alpha, which premultiplied ones are not."""
    one = 255.0 if pixels.dtype == torch.uint8 else 1.0
    return pixels.shape[2] == 4 and bool((pixels[..., :3].amax(dim=-1) > pixels[..., 3] + _ABOVE * one).any())


def checked_mask(name: str, mask: Any, pixels: Tensor) -> UInt8[Tensor, "H W"]:
    """A mask in bytes, 255 where pixels count; of booleans, or floats in [0, 1], as well.

    Raises:
        ValueError: of another shape than its photo, of another kind of numbers, or bytes of 0 and 1 alone.
    """
    height, width = pixels.shape[:2]
    check_shape(name, mask, (height, width))
    if mask.dtype == torch.bool:
        return mask.to(torch.uint8) * 255
    if mask.is_floating_point():
        low, high = (float(value) for value in torch.aminmax(mask))
        if not (low >= 0 and high <= 1):
            raise ValueError(f"{name} must be in [0, 1] where it is of floats, got {low:.4g} to {high:.4g}")
        return (mask * 255).round().to(torch.uint8)
    if mask.dtype != torch.uint8:
        raise ValueError(f"{name} must be of booleans, bytes or floats, got {mask.dtype}")
    if int(mask.max()) == 1:
        raise ValueError(f"{name} has 0 and 1 alone, and 255 is where pixels count: pass {name}.bool()")
    return mask


def as_many(name: str, values: Sequence[Any] | None, count: int) -> Sequence[Any]:
    """So many values, or None so often. Raises ValueError for another number of them."""
    if values is None:
        return [None] * count
    if len(values) != count:
        raise ValueError(f"{name}: expected {count}, one for each photo, got {len(values)}")
    return values


def checked_viewmats(viewmats: Any) -> Float[Tensor, "B 4 4"]:
    """Poses in float64. Raises ValueError where one is no rotation and translation from the world to a camera."""
    viewmats = _in_double("viewmats", viewmats, ("B", 4, 4))
    rotations = viewmats[:, :3, :3]
    off = (rotations @ rotations.mT - torch.eye(3, dtype=torch.float64)).abs().amax(dim=(1, 2))
    for wrong, why in (
        (off > _ROTATION, "is no rotation: its axes must be of length 1 and at right angles"),
        (torch.linalg.det(rotations) < 0, "is mirrored: axes must be x right, y down, z forward"),
    ):
        if bool(wrong.any()):
            raise ValueError(f"viewmats[{int(wrong.nonzero()[0])}]: its upper left 3x3 part {why}")
    last = (viewmats[:, 3] - torch.tensor([0.0, 0, 0, 1], dtype=torch.float64)).abs().amax(dim=1) > 1e-6
    if bool(last.any()):
        index = int(last.nonzero()[0])
        raise ValueError(f"viewmats[{index}]: its last row must be 0, 0, 0, 1; is it transposed?")
    return viewmats


def checked_intrinsics(Ks: Any) -> Float[Tensor, "B 3 3"]:
    """Intrinsics in float64. Raises ValueError where one has skew, or a focal length is not positive."""
    Ks = _in_double("Ks", Ks, ("B", 3, 3))
    wrong = (Ks[:, 0, 0] <= 0) | (Ks[:, 1, 1] <= 0)
    if bool(wrong.any()):
        raise ValueError(f"Ks[{int(wrong.nonzero()[0])}]: focal lengths must be above 0")
    pinholes = Ks * torch.eye(3, dtype=torch.float64)
    pinholes[:, :2, 2], pinholes[:, 2, 2] = Ks[:, :2, 2], 1.0
    off = (Ks - pinholes).abs()
    wrong = (off[:, :2, :2].amax(dim=(1, 2)) > _SKEW * Ks[:, 0, 0]) | (off[:, 2].amax(dim=1) > _AWAY)
    if bool(wrong.any()):
        form = "must have the form [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; skew is not supported"
        raise ValueError(f"Ks[{int(wrong.nonzero()[0])}]: {form}")
    return pinholes


def check_training_views(train: Sequence[int]) -> None:
    """Raises InputError where there are none."""
    if not train:
        raise InputError("capture: has no view to train on; name some in its split")


def checked_points(points: Any, colors: Any) -> tuple[Tensor, Tensor | None]:
    """Points in float64 and their colours in float32. Raises ValueError where they are none, or no such numbers."""
    points = _in_double("exact_points", points, ("P", 3))
    if not len(points):
        raise ValueError("exact_points: expected at least one; None where there are none")
    if colors is None:
        return points, None
    check_shape("point_colors", colors, (len(points), 3))
    if not colors.is_floating_point():
        raise ValueError(f"point_colors must be floats in [0, 1], got {colors.dtype}: divide bytes by 255")
    low, high = (float(value) for value in torch.aminmax(colors))
    if not (low >= -_ABOVE and high <= 1 + _ABOVE):
        raise ValueError(f"point_colors must be in [0, 1], got {low:.4g} to {high:.4g}")
    return points, colors.detach().float()


def checked_point(name: str, point: Any) -> Float[Tensor, "3"]:
    """A tensor (3,) as it is, or three numbers in float64. Raises ValueError for anything else."""
    three = isinstance(point, list | tuple | np.ndarray) and len(point) == 3
    tensor: Any = torch.tensor([float(number) for number in point], dtype=torch.float64) if three else point
    check_shape(name, tensor, (3,))
    check_floating(name, tensor)
    check_finite(name, tensor)
    return tensor


def checked_split(name: str, views: Iterable[Any], count: int) -> list[int]:
    """Indices of views as a list. Raises ValueError where one is none: floats are not, nor is a mask of all views."""
    wanted = f"{name}: expected indices in [0, {count}), got"
    if isinstance(views, str) or not isinstance(views, Iterable):
        raise ValueError(f"{wanted} {shown(views)}")
    indices = []
    for view in views:
        index = whole_number(view)
        if index is None:
            raise ValueError(f"{wanted} {view!r}{_INDICES_OF_FLAGS if isinstance(_plain(view), bool) else ''}")
        if not 0 <= index < count:
            raise ValueError(f"{wanted} {index}")
        indices.append(index)
    return indices


def _plain(value: Any) -> Any:
    """Of a tensor or array () what it holds."""
    return value.item() if isinstance(value, Tensor | np.ndarray | np.generic) and value.ndim == 0 else value


def _in_double(name: str, values: Any, shape: tuple[str | int, ...]) -> Tensor:
    check_shape(name, values, shape)
    if not values.is_floating_point():
        raise ValueError(f"{name} must be floats, got {values.dtype}")
    if not bool(values.isfinite().all()):
        raise ValueError(f"{name} must be finite")
    return values.detach().double()  # a run that walked through a graph of the caller's would find it freed
