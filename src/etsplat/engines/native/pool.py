"""Tensors from recycled memory."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from etsplat import _native


def empty_image(*shape: int) -> Tensor:
    """An uninitialised float32 CPU tensor, contiguous.

    Raises MemoryError, which says how much was wanted, where there is no room for it.

    Memory new to the process costs a page fault every 4 KiB at its first write, for an image of a million pixels as
    much as rendering it. Blocks return to the pool (csrc/cpu/pool.h) when their last tensor is freed.
    """
    return _image(_native.empty_floats, shape)


def empty(like: Tensor, *shape: int) -> Tensor:
    """An uninitialised float32 tensor beside ``like``; on devices torch recycles memory by itself."""
    return empty_image(*shape) if like.is_cpu else torch.empty(shape, device=like.device)


def zeros_image(*shape: int) -> Tensor:
    """Like ``empty_image``, zeroed by the engine's threads."""
    return _image(_native.zero_floats, shape)


def _image(make: Callable[..., Tensor], shape: tuple[int, ...]) -> Tensor:
    try:
        return make(shape=shape)
    except MemoryError:
        size = 4e-9 * math.prod(shape)
        raise MemoryError(
            f"no room for an image of shape {shape}, {size:,.0f} GB: draw fewer or smaller ones"
        ) from None


def copied_indices(indices: Tensor) -> Tensor:
    """A contiguous int32 copy of a dense int32 or int64 tensor, whose values fit."""
    if not indices.is_cpu:
        return indices.to(torch.int32, copy=True)
    return _native.copied_indices(values=indices)
