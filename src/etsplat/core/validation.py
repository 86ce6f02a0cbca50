"""Checks of tensor arguments; every failure is a ValueError that names the argument, what it got and what it wants."""

from collections.abc import Sequence

import torch
from torch import Tensor

Shape = tuple[str | int, ...]


def check_shape(name: str, tensor: Tensor, shapes: Sequence[Shape], sizes: dict[str, int]) -> None:
    """Match ``tensor`` to one of ``shapes`` and remember the sizes of the letters in it.

    Args:
        name: The argument, for the message.
        tensor: What was given.
        shapes: Acceptable shapes; a letter stands for a size.
        sizes: Letters with known sizes; letters first met here are added.

    Raises:
        ValueError: It is no tensor, or no shape matches.
    """
    wanted = " or ".join("(" + ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "") + ")" for shape in shapes)
    if not isinstance(tensor, Tensor):
        raise ValueError(f"{name} must be a tensor of shape {wanted}, got {type(tensor).__name__}")
    for shape in shapes:
        if len(shape) != tensor.ndim:
            continue
        found = dict(sizes)
        for letter, size in zip(shape, tensor.shape, strict=True):
            if size != (found.setdefault(letter, size) if isinstance(letter, str) else letter):
                break
        else:
            sizes.update(found)
            return
    letters = {s for shape in shapes for s in shape if isinstance(s, str) and s in sizes}
    known = ", ".join(f"{letter}={sizes[letter]}" for letter in sorted(letters))
    raise ValueError(f"{name} must have shape {wanted}{' with ' + known if known else ''}, got {tuple(tensor.shape)}")


def check_like(name: str, tensor: Tensor, other_name: str, other: Tensor) -> None:
    """Raise ValueError unless ``tensor`` has the dtype and device of ``other``."""
    if tensor.dtype != other.dtype:
        raise ValueError(f"{name} must be {other.dtype} like {other_name}, got {tensor.dtype}")
    check_device(name, tensor, other_name, other)


def check_device(name: str, tensor: Tensor, other_name: str, other: Tensor) -> None:
    """Raise ValueError unless ``tensor`` is on the device of ``other``."""
    if tensor.device != other.device:
        raise ValueError(f"{name} must be on {other.device} like {other_name}, got {tensor.device}")


def check_faces(name: str, faces: Tensor, num_vertices: int) -> None:
    """Raise ValueError unless ``faces`` are int32 or int64 indices into ``num_vertices`` vertices."""
    if faces.dtype not in (torch.int32, torch.int64):
        raise ValueError(f"{name} must be int32 or int64, got {faces.dtype}")
    if faces.numel() == 0:
        return
    low, high = (int(value) for value in torch.aminmax(faces))
    if low < 0 or high >= num_vertices:
        raise ValueError(f"{name} must index the {num_vertices} vertices, got indices from {low} to {high}")


def check_finite(name: str, tensor: Tensor) -> None:
    """Raise ValueError if ``tensor`` holds NaN or infinity; the message says how many."""
    finite = torch.isfinite(tensor)
    if not bool(finite.all()):
        raise ValueError(f"{name} must be finite, got {int((~finite).sum())} NaN or infinite values")


def check_choice(name: str, value: object, choices: Sequence[object]) -> None:
    """Raise ValueError unless ``value`` is one of ``choices``."""
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, choices))}, got {value!r}")
