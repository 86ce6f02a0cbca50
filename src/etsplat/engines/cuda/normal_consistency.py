"""The GPU engine's side of ``normal_consistency``: csrc/cuda/normal_consistency.cu."""

import ctypes
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from etsplat.core.validation import dense
from etsplat.engines.cuda.launch import blocks, launch
from etsplat.engines.cuda.program import Program
from etsplat.engines.cuda.structs import struct_class

_PROGRAM = Program("normal_consistency.cu", contract=False)
_THREADS = 256


def normal_consistency(normals: Tensor, depth: Tensor, alpha: Tensor, viewmats: Tensor, Ks: Tensor) -> Tensor:
    """See `Engine.normal_consistency`."""
    loss: Any = _NormalConsistency.apply(normals, depth, alpha.detach(), viewmats.detach(), Ks.detach())
    return loss


class _NormalConsistency(torch.autograd.Function):
    """Backward computes again what forward did, rather than keep it."""

    @staticmethod
    def forward(ctx: Any, *given: Tensor) -> Tensor:
        inputs = [dense(tensor) for tensor in given]
        problem, grid = _problem(inputs)
        sums = inputs[0].new_empty(grid[0] * grid[1], dtype=torch.float64)
        loss = inputs[0].new_empty(())
        launch(_PROGRAM, "normal_sums", grid, _THREADS, (problem, sums))
        launch(_PROGRAM, "normal_mean", 1, _THREADS, (problem, sums, ctypes.c_int64(len(sums)), loss))
        ctx.save_for_backward(*inputs)
        return loss

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_loss: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """``grad_loss`` stays in device memory."""
        inputs = [dense(tensor) for tensor in ctx.saved_tensors]
        problem, grid = _problem(inputs)
        grads = torch.empty_like(inputs[0]), torch.empty_like(inputs[1])
        launch(_PROGRAM, "normal_backward", grid, _THREADS, (problem, dense(grad_loss), *grads))
        return *grads, None, None, None


def _problem(inputs: Any) -> tuple[Any, tuple[int, int]]:
    """The kernels' struct and their grid: blocks of a view, views."""
    views, height, width = inputs[0].shape[:3]
    struct_of = struct_class("cuda/normal_consistency.cu", "DepthNormals")
    struct = struct_of(*(tensor.data_ptr() for tensor in inputs), views, height, width)
    return struct, (blocks(height * width, _THREADS), views)
