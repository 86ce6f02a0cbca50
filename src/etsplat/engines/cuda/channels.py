"""The GPU engine's side of depths and normals as channels: csrc/cuda/triangle_channels.cu and pick_values.cu."""

import ctypes
from typing import Any

import torch
from torch import Tensor

from etsplat.engines.cuda.capacity import check_summed
from etsplat.engines.cuda.launch import blocks, launch, launch_each
from etsplat.engines.cuda.program import Program
from etsplat.engines.cuda.structs import struct_class
from etsplat.engines.native.operation import differentiable

_CHANNELS = Program("triangle_channels.cu", contract=False)
_PICK = Program("pick_values.cu", contract=False)
CHANNELS_THREADS = 128
_PICK_THREADS = 256


def channels_forward(corners: Tensor, viewmats: Tensor, depth: bool, normals: bool, channels: Tensor) -> None:
    """See `etsplat.engines.native.triangle_channels.triangle_channels`."""
    _run("triangle_channels_forward", _channels_of(corners, viewmats, depth, normals), channels)


def channels_backward(
    corners: Tensor, viewmats: Tensor, depth: bool, normals: bool, grad_channels: Tensor, grad_corners: Tensor
) -> None:
    """See `etsplat.engines.native.triangle_channels.triangle_channels`."""
    _run("triangle_channels_gradient", _channels_of(corners, viewmats, depth, normals), grad_channels, grad_corners)


def _run(kernel: str, struct: Any, *images: Tensor) -> None:
    launch_each(_CHANNELS, kernel, struct.triangles, (struct, *images), CHANNELS_THREADS)


def _channels_of(corners: Tensor, viewmats: Tensor, depth: bool, normals: bool) -> Any:
    addresses = corners.data_ptr(), viewmats.data_ptr()
    return struct_class("cuda/triangle_channels.cu", "ChannelsOf")(
        *addresses, len(corners), len(viewmats), depth, normals
    )


def _pick(keep: bool, values: Tensor, chosen: Tensor) -> tuple[Tensor, Any]:
    if keep:
        check_summed("pick_values", chosen[:1].numel(), 1)
    image = values.new_empty(chosen.shape)
    grid, sizes = _views(values, chosen)
    launch(_PICK, "pick_forward", grid, _PICK_THREADS, (values, chosen, *sizes, image))
    return image, (values, chosen)


def _pick_backward(kept: Any, _needed: Any, grad_image: Tensor) -> tuple[Tensor]:
    values, chosen = kept
    grid, sizes = _views(values, chosen)
    words = torch.zeros(values.numel() + 1, dtype=torch.int64, device=values.device)
    largest, sums = words[:1], words[1:]
    launch(_PICK, "pick_largest", grid, _PICK_THREADS, (grad_image, chosen, *sizes, largest))
    launch(_PICK, "pick_add", grid, _PICK_THREADS, (grad_image, chosen, *sizes, largest, sums))
    grad_values, count = torch.empty_like(values), values.numel()
    launch_each(_PICK, "pick_finish", count, (sums, largest, ctypes.c_int64(count), grad_values), _PICK_THREADS)
    return (grad_values,)


def _views(values: Tensor, chosen: Tensor) -> tuple[tuple[int, int], tuple[ctypes.c_int64, ctypes.c_int64]]:
    """Blocks of a view and views; pixels and triangles of a view."""
    pixels = chosen.shape[1] * chosen.shape[2]
    return (blocks(pixels, _PICK_THREADS), len(values)), (ctypes.c_int64(pixels), ctypes.c_int64(values.shape[1]))


pick_values = differentiable(_pick, _pick_backward)
