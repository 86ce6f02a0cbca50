"""Tensors from recycled memory."""

import torch
from torch import Tensor

from etsplat import _native


def empty_image(*shape: int) -> Tensor:
    """An uninitialised float32 CPU tensor, contiguous.

    Memory new to the process costs a page fault every 4 KiB at its first write, for an image of a million pixels as
    much as rendering it. Blocks return to the pool (csrc/cpu/pool.h) when their last tensor is freed.
    """
    return _native.empty_floats(shape=shape)


def empty(like: Tensor, *shape: int) -> Tensor:
    """An uninitialised float32 tensor beside ``like``; on devices torch recycles memory by itself."""
    return empty_image(*shape) if like.is_cpu else torch.empty(shape, device=like.device)


def zeros_image(*shape: int) -> Tensor:
    """Like ``empty_image``, zeroed by the engine's threads."""
    return _native.zero_floats(shape=shape)


def copied_indices(indices: Tensor) -> Tensor:
    """A contiguous int32 copy of a dense int32 or int64 tensor, whose values fit."""
    if not indices.is_cpu:
        return indices.to(torch.int32, copy=True)
    return _native.copied_indices(values=indices)
