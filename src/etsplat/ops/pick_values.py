"""A value of each triangle, such as its depth, at the pixels that show it."""

import ctypes
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from etsplat.core.validation import check_device, check_shape, dense
from etsplat.cuda.launch import blocks, launch
from etsplat.cuda.program import Program
from etsplat.ops.engines import resolve_engine

_PROGRAM = Program("pick_values.cu", contract=False)
_THREADS = 256


def pick_values(
    values: Float[Tensor, "B N"], chosen: Int[Tensor, "B H W"], *, engine: str | None = None
) -> Float[Tensor, "B H W"]:
    """``values[b, chosen[b, i, j] - 1]``, 0 where ``chosen`` is 0; differentiable with respect to ``values``.

    How many pixels are 0 is not asked, which on a GPU would mean to wait for it.

    Args:
        values: (B, N).
        chosen: (B, H, W) int32 from 0 to N.
        engine: "cpu", "cuda", "reference" or None (by dtype and device). Only "cuda" has anything of its own.

    Returns:
        (B, H, W). Gradients are added in a fixed order, or as integers: the same bits in every run.

    Raises:
        ValueError: Wrong shape, dtype or device.
    """
    check_shape("values", values, ("B", "N"))
    check_shape("chosen", chosen, (len(values), "H", "W"))
    check_device("chosen", chosen, "values", values)
    if chosen.dtype != torch.int32:
        raise ValueError(f"chosen must be int32, got {chosen.dtype}")
    if resolve_engine(engine, values) == "cuda":
        picked: Any = _OnDevice.apply(values, chosen)
        return picked
    behind = torch.cat([values.new_zeros(len(values), 1), values], dim=1)
    return behind.gather(1, chosen.long().flatten(start_dim=1)).view(chosen.shape)


class _OnDevice(torch.autograd.Function):
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
