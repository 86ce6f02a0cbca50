"""Valid arguments, with some of them made odd."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

Arguments = dict[str, Any]

_NUMBERS = (math.nan, math.inf, -math.inf, 0.0, -0.0, -1.0, 1e-45, 1e-30, 1e30, 1e38, -1e38, 3.4e38)
_INDICES = (-1, 0, 1, 2**31 - 1, 2**31, -(2**31), 2**63 - 1, -(2**63), 10**6)
_SCALARS = (0, 1, -1, 2, 3, 17, 257, 0.5, 1e-30, math.nan, math.inf, -math.inf, True)
_OTHERS = (None, "elastic", "", (), [0.5], np.float32(0.5), 2**40, object, np.zeros(3, dtype=np.float32))


@dataclass(frozen=True)
class Odd:
    """Arguments of a call.

    Attributes:
        values: by name.
        changes: what was done to which, in words.
        untyped: whether some are not of the type that the signature has, so that TypeError is an answer.
    """

    values: Arguments
    changes: tuple[str, ...]
    untyped: bool

    def __repr__(self) -> str:
        return "\n".join([*self.changes, *(f"{name} = {_described(value)}" for name, value in self.values.items())])


def _described(value: Any) -> str:
    """A tensor by its outside: to print one without memory is a crash."""
    if not isinstance(value, Tensor) or value.layout != torch.strided:
        return repr(value)
    return f"{tuple(value.shape)} {value.dtype} {value.device} strides {value.stride()}"


def odd(valid: Arguments, rng: np.random.Generator) -> Odd:
    """Mostly one argument, sometimes none or several, made odd."""
    values, changes, untyped = dict(valid), [], False
    able = [name for name, value in valid.items() if isinstance(value, Tensor | int | float | str)]
    for name in rng.permutation(able)[: int(rng.choice((0, 1, 1, 1, 2, 3)))].tolist():
        value = values[name]
        if isinstance(value, Tensor) and rng.random() < 0.95:
            values[name], said = _odd_tensor(value, rng)
        elif isinstance(value, int | float) and rng.random() < 0.8:
            values[name] = said = _SCALARS[int(rng.integers(len(_SCALARS)))]
            untyped = untyped or not isinstance(values[name], type(value))
        else:
            values[name] = _OTHERS[int(rng.integers(len(_OTHERS)))]
            said, untyped = "something else", True
        changes.append(f"{name}: {said}")
    return Odd(values, tuple(changes), untyped)


def _odd_tensor(tensor: Tensor, rng: np.random.Generator) -> tuple[Tensor, str]:
    kinds = list(_CHANGES)
    kind = kinds[int(rng.integers(len(kinds)))]
    return _CHANGES[kind](tensor, rng), kind


def _with_number(tensor: Tensor, rng: np.random.Generator) -> Tensor:
    """One element, or all, are another number."""
    made = tensor.detach().clone()
    if made.numel() == 0 or made.dtype == torch.bool:
        return made.logical_not() if made.dtype == torch.bool else made
    if made.is_floating_point():
        number = _NUMBERS[int(rng.integers(len(_NUMBERS)))]
    else:
        low, high = torch.iinfo(made.dtype).min, torch.iinfo(made.dtype).max
        number = min(max(_INDICES[int(rng.integers(len(_INDICES)))], low), high)
    if rng.random() < 0.2:
        return made.fill_(number)
    made.view(-1)[int(rng.integers(made.numel()))] = number
    return made


def _with_dtype(tensor: Tensor, rng: np.random.Generator) -> Tensor:
    kinds = (torch.float64, torch.float16, torch.bfloat16, torch.int64, torch.int32, torch.uint8, torch.bool)
    return tensor.detach().to((*kinds, torch.complex64)[int(rng.integers(len(kinds) + 1))])


def _strided(tensor: Tensor, rng: np.random.Generator) -> Tensor:
    """The same values with other strides: every second of a larger tensor, from behind."""
    if tensor.ndim == 0:
        return tensor.detach().repeat(3)[1]
    dim = int(rng.integers(tensor.ndim))
    room = torch.cat([tensor.detach()] * 2, dim=dim).flip(dim)
    index = torch.arange(tensor.shape[dim])
    room.index_copy_(dim, 2 * index, tensor.detach())
    return room[(slice(None),) * dim + (slice(0, 2 * tensor.shape[dim], 2),)]


def _transposed(tensor: Tensor, rng: np.random.Generator) -> Tensor:
    """The same values in column order."""
    return tensor.detach().mT.contiguous().mT if tensor.ndim > 1 else tensor.detach().clone()


def _expanded(tensor: Tensor, rng: np.random.Generator) -> Tensor:
    """One row for all of them, without memory of their own."""
    return tensor.detach()[:1].expand(tensor.shape) if tensor.ndim else tensor.detach()


def _resized(tensor: Tensor, rng: np.random.Generator) -> Tensor:
    """Shorter or longer along a dimension, or empty."""
    if tensor.ndim == 0:
        return tensor.detach()[None]
    dim, size = int(rng.integers(tensor.ndim)), int(rng.choice((0, 0, 1, 2, 5)))
    size = min(size, tensor.shape[dim])
    shorter = tensor.detach().narrow(dim, 0, size)
    return shorter if rng.random() < 0.7 else torch.cat([tensor.detach(), shorter], dim=dim)


def _reshaped(tensor: Tensor, rng: np.random.Generator) -> Tensor:
    made = tensor.detach()
    return (made[None], made.flatten(), made.unsqueeze(-1), made.mT if made.ndim > 1 else made)[int(rng.integers(4))]


def _on_meta(tensor: Tensor, rng: np.random.Generator) -> Tensor:
    return tensor.detach().to("meta")


def _without_memory(tensor: Tensor, rng: np.random.Generator) -> Tensor:
    made = tensor.detach().clone()
    made.untyped_storage().resize_(0)
    return made


def _sparse(tensor: Tensor, rng: np.random.Generator) -> Tensor:
    return tensor.detach().to_sparse()


def _negated_view(tensor: Tensor, rng: np.random.Generator) -> Tensor:
    """The same values, with a sign that memory does not show."""
    return torch._neg_view(-tensor.detach()) if tensor.is_floating_point() else tensor.detach()


def _growing(tensor: Tensor, rng: np.random.Generator) -> Tensor:
    return tensor.detach().clone().requires_grad_(tensor.is_floating_point())


_CHANGES: dict[str, Callable[[Tensor, np.random.Generator], Tensor]] = {
    "a number": _with_number,
    "numbers": lambda tensor, rng: _with_number(_with_number(tensor, rng), rng),
    "dtype": _with_dtype,
    "strides": _strided,
    "column order": _transposed,
    "expanded": _expanded,
    "size": _resized,
    "shape": _reshaped,
    "device": _on_meta,
    "no memory": _without_memory,
    "sparse": _sparse,
    "negated view": _negated_view,
    "wants a gradient": _growing,
}
