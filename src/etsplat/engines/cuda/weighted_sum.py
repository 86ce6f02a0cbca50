"""The GPU engine's side of `weighted_sum`: csrc/cuda/weighted_sum.cu."""

import ctypes
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from etsplat.core.validation import dense
from etsplat.engines.cuda.launch import launch
from etsplat.engines.cuda.program import Program

_PROGRAM = Program("weighted_sum.cu", contract=False)
_TERMS = 6  # of one launch: WeightedTerms of csrc/cuda/weighted_sum.cu


def weighted_sum(
    first: Tensor,
    values: Sequence[Tensor],
    weights: Sequence[float],
    powers: Sequence[int],
    scale: float | Tensor,
) -> Tensor:
    """See `Engine.weighted_sum`."""
    factor, on_host = (scale, 1.0) if isinstance(scale, Tensor) else (None, scale)
    total: Any = first
    for begin in range(0, len(values), _TERMS):
        end = begin + _TERMS
        settings = [on_host * weight for weight in weights[begin:end]], list(powers[begin:end])
        total = _WeightedSum.apply(settings, factor, total, *values[begin:end])
    return total


class _WeightedTerms(ctypes.Structure):
    _fields_ = (
        ("values", ctypes.c_void_p * _TERMS),
        ("weights", ctypes.c_float * _TERMS),
        ("powers", ctypes.c_int * _TERMS),
        ("count", ctypes.c_int),
    )


class _WeightedSum(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, settings: tuple[list[float], list[int]], scale: Tensor | None, first: Tensor, *values: Tensor
    ) -> Tensor:
        scale, values = None if scale is None else dense(scale), tuple(map(dense, values))
        ctx.save_for_backward(*([] if scale is None else [scale]), *values)
        ctx.settings, ctx.scaled = settings, scale is not None
        total = first.new_empty(())
        launch(_PROGRAM, "weighted_sum", 1, 1, (dense(first), _table(settings, values), scale, total))
        return total

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_sum: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """``grad_sum`` stays in device memory."""
        saved = [dense(tensor) for tensor in ctx.saved_tensors]
        values, scale = (saved[1:], saved[0]) if ctx.scaled else (saved, None)
        gradients = grad_sum.new_empty(1 + len(values))
        launch(
            _PROGRAM, "weighted_sum_backward", 1, 1, (_table(ctx.settings, values), scale, dense(grad_sum), gradients)
        )
        return None, None, *gradients.unbind()


def _table(settings: tuple[list[float], list[int]], values: Sequence[Tensor]) -> _WeightedTerms:
    table = _WeightedTerms(count=len(values))
    for k, (weight, power, value) in enumerate(zip(*settings, values, strict=True)):
        table.values[k], table.weights[k], table.powers[k] = value.data_ptr(), weight, power
    return table
