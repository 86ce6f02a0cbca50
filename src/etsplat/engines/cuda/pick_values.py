"""The GPU engine's side of `pick_values`: csrc/cuda/pick_values.cu."""

import ctypes
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from etsplat.core.validation import dense
from etsplat.engines.cuda.launch import blocks, launch
from etsplat.engines.cuda.program import Program

_PROGRAM = Program("pick_values.cu", contract=False)
_THREADS = 256


def pick_values(values: Tensor, chosen: Tensor) -> Tensor:
    """See `Engine.pick_values`."""
    picked: Any = _PickValues.apply(values, chosen)
    return picked


class _PickValues(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, chosen: Tensor) -> Tensor:
        values, chosen = dense(values, "values"), dense(chosen, "chosen")
        image = values.new_empty(chosen.shape)
        grid, sizes = _problem(values, chosen)
        launch(_PROGRAM, "pick_forward", grid, _THREADS, (values, chosen, *sizes, image))
        ctx.save_for_backward(values, chosen)
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor) -> tuple[Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        values, chosen = map(dense, ctx.saved_tensors)
        given, grid, sizes = dense(grad_image), *_problem(values, chosen)
        words = torch.zeros(values.numel() + 1, dtype=torch.int64, device=values.device)
        largest, sums = words[:1], words[1:]
        launch(_PROGRAM, "pick_largest", grid, _THREADS, (given, chosen, *sizes, largest))
        launch(_PROGRAM, "pick_add", grid, _THREADS, (given, chosen, *sizes, largest, sums))
        grad_values = torch.empty_like(values)
        count = values.numel()
        arguments = (sums, largest, ctypes.c_int64(count), grad_values)
        launch(_PROGRAM, "pick_finish", blocks(count, _THREADS), _THREADS, arguments)
        return grad_values, None


def _problem(values: Tensor, chosen: Tensor) -> tuple[tuple[int, int], tuple[ctypes.c_int64, ctypes.c_int64]]:
    """Blocks of a view and views; pixels and triangles of a view."""
    pixels = chosen.shape[1] * chosen.shape[2]
    return (blocks(pixels, _THREADS), len(values)), (ctypes.c_int64(pixels), ctypes.c_int64(values.shape[1]))
