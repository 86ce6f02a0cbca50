"""The GPU engine's side of ``Adam``: csrc/cuda/adam.cu."""

import ctypes
from collections.abc import Sequence

from torch import Tensor

from etsplat.engines.cuda.launch import blocks, launch
from etsplat.engines.cuda.program import Program
from etsplat.engines.cuda.transfer import upload
from etsplat.engines.engine import AdamGroup, step_rates

_PROGRAM = Program("adam.cu", contract=False)
_THREADS, _ELEMENTS = 256, 1024
_MAX_PARAMETERS = 8


class _AdamParameters(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_void_p * _MAX_PARAMETERS) for name in ("values", "gradients", "firsts", "seconds")),
        ("sizes", ctypes.c_int64 * _MAX_PARAMETERS),
    )


def adam_step(
    groups: Sequence[AdamGroup],
    learning_rates: Sequence[float],
    betas: tuple[float, float],
    eps: float,
    step_count: int,
) -> None:
    """See `Engine.adam_step`."""
    rates = upload(step_rates(learning_rates, betas, step_count), groups[0][0].device)
    adam_step_queued(groups, rates, betas, eps, None)


def adam_step_queued(
    groups: Sequence[AdamGroup],
    rates: Tensor,
    betas: tuple[float, float],
    eps: float,
    halted: Tensor | None,
) -> None:
    """See `QueuedSteps.adam_step`; None never halts."""
    first_beta, second_beta = betas
    for first in range(0, len(groups), _MAX_PARAMETERS):
        chosen = groups[first : first + _MAX_PARAMETERS]
        sizes = [group[0].numel() for group in chosen]
        table = _AdamParameters()
        for p, group in enumerate(chosen):
            table.values[p], table.gradients[p], table.firsts[p], table.seconds[p] = (t.data_ptr() for t in group)
            table.sizes[p] = sizes[p]
        constants = 1 - first_beta, second_beta, 1 - second_beta, eps
        arguments = (table, len(chosen), rates[first:], rates[len(groups) :], *constants, halted)
        launch(_PROGRAM, "adam_step", sum(blocks(size, _ELEMENTS) for size in sizes), _THREADS, arguments)
