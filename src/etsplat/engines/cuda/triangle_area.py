"""The GPU engine's side of `mean_area`: csrc/cuda/triangle_area.cu."""

import ctypes
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from etsplat.core.validation import dense
from etsplat.engines.cuda.launch import blocks, launch
from etsplat.engines.cuda.program import Program

_PROGRAM = Program("triangle_area.cu", contract=False)
_THREADS = 256


def mean_area(vertices: Tensor) -> Tensor:
    """See `Engine.mean_area`."""
    area: Any = _MeanArea.apply(vertices)
    return area


class _MeanArea(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, vertices: Tensor) -> Tensor:
        vertices = dense(vertices, "vertices")
        grid = blocks(len(vertices), _THREADS)
        sums, mean = vertices.new_empty(grid, dtype=torch.float64), vertices.new_empty(())
        launch(_PROGRAM, "area_sums", grid, _THREADS, (vertices, len(vertices), sums))
        launch(_PROGRAM, "area_mean", 1, _THREADS, (sums, ctypes.c_int64(grid), len(vertices), mean))
        ctx.save_for_backward(vertices)
        return mean

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_area: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        """``grad_area`` stays in device memory."""
        vertices = dense(ctx.saved_tensors[0])
        gradient = torch.empty_like(vertices)
        arguments = (vertices, len(vertices), dense(grad_area), gradient)
        launch(_PROGRAM, "area_backward", blocks(len(vertices), _THREADS), _THREADS, arguments)
        return gradient
