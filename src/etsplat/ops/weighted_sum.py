"""An objective from its terms, all of them numbers: first + scale sum_k weight_k value_k^power_k."""

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from etsplat.core.validation import check_like, check_shape, dense
from etsplat.cuda.launch import launch
from etsplat.cuda.program import Program
from etsplat.ops.engines import resolve_engine

_PROGRAM = Program("weighted_sum.cu", contract=False)
_MAX_TERMS = 6


@dataclass(frozen=True)
class Term:
    """weight value^power, with a scalar value."""

    weight: float
    value: Float[Tensor, ""]
    power: Literal[1, -1, -2] = 1


def weighted_sum(
    first: Float[Tensor, ""],
    terms: Sequence[Term],
    scale: float | Float[Tensor, ""] = 1.0,
    *,
    engine: str | None = None,
) -> Float[Tensor, ""]:
    """The sum, differentiable with respect to ``first`` and the terms' values.

    Args:
        first: Scalar.
        terms: At most 6.
        scale: Of the terms; a number, or a scalar tensor, which receives no gradient.
        engine: "cpu", "cuda", "reference" or None (by dtype and device). Only "cuda" has anything of its own.

    Raises:
        ValueError: Wrong shape, dtype or device, or too many terms.
    """
    check_shape("first", first, ())
    for term in terms:
        check_shape("value", term.value, ())
        check_like("value", term.value, "first", first)
    if len(terms) > _MAX_TERMS:
        raise ValueError(f"terms must be at most {_MAX_TERMS}, got {len(terms)}")
    if not terms:
        return first
    if resolve_engine(engine, first) == "cuda":
        factor, on_host = (scale, 1.0) if isinstance(scale, Tensor) else (None, scale)
        settings = [on_host * term.weight for term in terms], [term.power for term in terms]
        on_device: Any = _WeightedSum.apply(settings, factor, first, *(term.value for term in terms))
        return on_device
    total, *others = (term.weight * (term.value if term.power == 1 else term.value.pow(term.power)) for term in terms)
    for other in others:
        total = total + other
    return first + scale * total


class _WeightedTerms(ctypes.Structure):
    _fields_ = (
        ("values", ctypes.c_void_p * _MAX_TERMS),
        ("weights", ctypes.c_float * _MAX_TERMS),
        ("powers", ctypes.c_int * _MAX_TERMS),
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
