"""The GPU engine's side of ``photometric_loss``: csrc/cuda/photometric.cu."""

import ctypes
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from etsplat.core.validation import dense
from etsplat.engines.cuda.launch import blocks, launch
from etsplat.engines.cuda.program import Program
from etsplat.engines.cuda.structs import struct_class

_PROGRAM = Program("photometric.cu", contract=False)
_TILE = 16
_THREADS = _TILE * _TILE


def photometric_loss(
    color: Tensor,
    target: Tensor,
    mask: Tensor | None,
    backgrounds: Tensor | None,
    dssim_weight: float,
    squared: bool,
) -> Tensor:
    """See `Engine.photometric_loss`."""
    loss: Any = _PhotometricLoss.apply(color, target, mask, backgrounds, dssim_weight, squared)
    return loss


class _PhotometricLoss(torch.autograd.Function):
    """Forward keeps the derivatives of SSIM by its moments, which backward blurs once more; both read the images."""

    @staticmethod
    def forward(
        ctx: Any,
        color: Tensor,
        target: Tensor,
        mask: Tensor | None,
        backgrounds: Tensor | None,
        dssim_weight: float,
        squared: bool,
    ) -> Tensor:
        images = [None if image is None else dense(image) for image in (color, target, backgrounds, mask)]
        B, H, W = color.shape[:3]
        maps = color.new_empty((B, 3, 3, H, W)) if ctx.needs_input_grad[0] and dssim_weight > 0 else None
        grid = _grid(color)
        sums = color.new_empty((grid[0] * grid[1] * grid[2], 2), dtype=torch.float64)
        loss = color.new_empty(())
        problem = _problem(images, dssim_weight, squared)
        launch(_PROGRAM, "photometric_sums", grid, _THREADS, (problem, maps, sums))
        launch(_PROGRAM, "photometric_loss", 1, _THREADS, (problem, sums, ctypes.c_int64(len(sums)), loss))
        ctx.save_for_backward(*images, maps)
        ctx.settings = dssim_weight, squared
        return loss

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_loss: Tensor) -> tuple[Tensor, None, None, None, None, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """``grad_loss`` stays in device memory."""
        *images, maps = (None if saved is None else dense(saved) for saved in ctx.saved_tensors)
        color: Any = images[0]
        gradient = torch.empty_like(color)
        arguments = (_problem(images, *ctx.settings), maps, dense(grad_loss), gradient)
        launch(_PROGRAM, "photometric_backward", _grid(gradient), _THREADS, arguments)
        return gradient, None, None, None, None, None


def _problem(images: list[Any], dssim_weight: float, squared: bool) -> Any:
    """Of color, target, backgrounds, mask; the latter two may be None."""
    color, target = images[:2]
    addresses = (None if image is None else image.data_ptr() for image in images)
    return struct_class("cuda/photometric.cu", "Photometric")(
        *addresses, *color.shape[:3], target.shape[-1], target.dtype == torch.uint8, squared, dssim_weight
    )


def _grid(color: Tensor) -> tuple[int, int, int]:
    return blocks(color.shape[2], _TILE), blocks(color.shape[1], _TILE), len(color)
