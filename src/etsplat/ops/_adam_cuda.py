"""The GPU engine's side of ``Adam``: csrc/cuda/adam.cu."""

import ctypes
from collections.abc import Sequence

from torch import Tensor

from etsplat.cuda.launch import blocks, launch
from etsplat.cuda.program import Program

_PROGRAM = Program("adam.cu", contract=False)
_THREADS, _ELEMENTS = 256, 1024
_MAX_PARAMETERS = 8


class _AdamParameters(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_void_p * _MAX_PARAMETERS) for name in ("values", "gradients", "firsts", "seconds")),
        ("sizes", ctypes.c_int64 * _MAX_PARAMETERS),
    )


def adam_step_cuda(
    parameters: Sequence[tuple[Tensor, Tensor, Tensor, Tensor]],
    rates: Tensor,
    betas: tuple[float, float],
    eps: float,
    halted: Tensor | None,
) -> None:
    """Update parameters in place.

    Args:
        parameters: of each the value, the gradient and both moments, all contiguous.
        rates: (P + 1,) float32 in device memory: the step size of each parameter, then sqrt(1 - beta2^t).
        betas: of Adam.
        eps: of Adam.
        halted: () int32 in device memory; nothing is updated where it is not 0.
    """
    first_beta, second_beta = betas
    for first in range(0, len(parameters), _MAX_PARAMETERS):
        chosen = parameters[first : first + _MAX_PARAMETERS]
        sizes = [group[0].numel() for group in chosen]
        table = _AdamParameters()
        for p, group in enumerate(chosen):
            table.values[p], table.gradients[p], table.firsts[p], table.seconds[p] = (t.data_ptr() for t in group)
            table.sizes[p] = sizes[p]
        constants = 1 - first_beta, second_beta, 1 - second_beta, eps
        arguments = (table, len(chosen), rates[first:], rates[len(parameters) :], *constants, halted)
        launch(_PROGRAM, "adam_step", sum(blocks(size, _ELEMENTS) for size in sizes), _THREADS, arguments)
