"""The GPU engine's side of ``l1_over_background``: csrc/cuda/photometric.cu."""

import ctypes
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from etsplat.cuda.launch import blocks, launch
from etsplat.cuda.program import Program

_PROGRAM = Program("photometric.cu", contract=False)
_THREADS, _PIXELS = 256, 1024


class L1OverBackgroundCuda(torch.autograd.Function):
    """Value and gradient each read the images once."""

    @staticmethod
    def forward(ctx: Any, color: Tensor, target: Tensor, backgrounds: Tensor) -> Tensor:
        """See ``l1_over_background``."""
        images = color.contiguous(), target.contiguous(), backgrounds.contiguous()
        grid, pixels = _grid(color)
        sums = color.new_empty(grid[0] * grid[1], dtype=torch.float64)
        mean = color.new_empty(())
        launch(_PROGRAM, "l1_sums", grid, _THREADS, (*images, ctypes.c_int64(pixels), sums))
        counts = ctypes.c_int64(sums.numel()), ctypes.c_int64(color.numel())
        launch(_PROGRAM, "l1_mean", 1, _THREADS, (sums, *counts, mean))
        ctx.save_for_backward(*images)
        return mean

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_loss: Tensor) -> tuple[Tensor, None, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """``grad_loss`` stays in device memory."""
        images = ctx.saved_tensors
        gradient = torch.empty_like(images[0])
        grid, pixels = _grid(gradient)
        launch(_PROGRAM, "l1_backward", grid, _THREADS, (*images, ctypes.c_int64(pixels), grad_loss, gradient))
        return gradient, None, None


def _grid(color: Tensor) -> tuple[tuple[int, int], int]:
    """Blocks of a view, views; and the pixels of a view."""
    pixels = color.shape[1] * color.shape[2]
    return (blocks(pixels, _PIXELS), len(color)), pixels
