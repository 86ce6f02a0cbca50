"""Checks of tensor arguments: shape, dtype, device, index range. Each raises a ValueError that names the argument."""

import torch
from torch import Tensor


def check_shape(name: str, tensor: Tensor, shape: tuple[int | str, ...]) -> None:
    """Check ``tensor``'s shape.

    Args:
        name: The argument's name.
        tensor: The argument.
        shape: The sizes wanted; a letter stands for any size (``("B", 4, 4)``).

    Raises:
        ValueError: The number of dimensions or a size differs.
    """
    fits = tensor.ndim == len(shape) and all(
        isinstance(want, str) or want == got for want, got in zip(shape, tensor.shape, strict=True)
    )
    if not fits:
        wanted = ", ".join(str(size) for size in shape) + ("," if len(shape) == 1 else "")
        raise ValueError(f"{name} must have shape ({wanted}), got {tuple(tensor.shape)}")


def check_matches(name: str, tensor: Tensor, like: Tensor) -> None:
    """Check that ``tensor`` has the dtype and the device of ``like``.

    Raises:
        ValueError: It has another dtype or lies on another device.
    """
    if tensor.dtype != like.dtype or tensor.device != like.device:
        raise ValueError(f"{name} must be {like.dtype} on {like.device}, got {tensor.dtype} on {tensor.device}")


def check_indices(name: str, indices: Tensor, count: int) -> None:
    """Check that ``indices`` are int32 or int64 and within [0, count).

    Raises:
        ValueError: Another dtype, or an index out of range.
    """
    if indices.dtype not in (torch.int32, torch.int64):
        raise ValueError(f"{name} must be int32 or int64, got {indices.dtype}")
    if indices.numel() == 0:
        return
    low, high = (int(end) for end in torch.aminmax(indices))
    if low < 0 or high >= count:
        raise ValueError(f"{name} must be indices from 0 to {count - 1}, got indices from {low} to {high}")
