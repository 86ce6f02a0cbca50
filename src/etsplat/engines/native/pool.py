"""Tensors from recycled memory."""

import math

import torch
from torch import Tensor

from etsplat import _native

_SMALLEST = 1 << 16  # floats; below, the allocator of the C library recycles by itself


def empty_image(*shape: int) -> Tensor:
    """An uninitialised float32 CPU tensor, contiguous.

    Memory new to the process costs a page fault every 4 KiB at its first write, for an image of a million pixels as
    much as rendering it. Blocks return to the pool (csrc/cpu/pool.h) when their last tensor is freed.
    """
    count = math.prod(shape)
    if count < _SMALLEST:
        return torch.empty(shape)
    return torch.from_numpy(_native.pooled_floats(count=count)).view(shape)


def empty(like: Tensor, *shape: int) -> Tensor:
    """An uninitialised float32 tensor beside ``like``; on devices torch recycles memory by itself."""
    return empty_image(*shape) if like.is_cpu else torch.empty(shape, device=like.device)


def zeros_image(*shape: int) -> Tensor:
    """Like ``empty_image``, zeroed by the engine's threads."""
    zeros = empty_image(*shape)
    _native.zero_floats(values=zeros)
    return zeros


def copied_indices(indices: Tensor) -> Tensor:
    """A contiguous int32 copy of a dense int32 or int64 tensor, whose values fit."""
    if not indices.is_cpu:
        return indices.to(torch.int32, copy=True)
    copies = empty_image(*indices.shape).view(torch.int32)
    _native.copy_indices(values=indices, copies=copies)
    return copies
