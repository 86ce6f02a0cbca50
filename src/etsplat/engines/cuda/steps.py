"""Steps of a fit on a GPU, queued as CUDA graphs: csrc/cuda/adam.cu, soup_statistics.cu and step.cu."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from etsplat.core.rasterization import TriangleStatistics
from etsplat.engines.cuda.capacity import overflow_flag, repair_overflow
from etsplat.engines.cuda.launch import backend, blocks, launch, launch_each, upload
from etsplat.engines.cuda.program import Program
from etsplat.engines.cuda.soup import colors_adam
from etsplat.engines.cuda.structs import constant, struct_class
from etsplat.engines.reference.steps import AdamGroup, step_rates

_ADAM = Program("adam.cu", contract=False)
_STATISTICS = Program("soup_statistics.cu", contract=False)
_STEP = Program("step.cu", contract=False)
_ADAM_THREADS, _ADAM_ELEMENTS = (constant("cuda/adam.cu", name) for name in ("kThreads", "kElements"))


def adam_step(
    groups: Sequence[AdamGroup],
    learning_rates: Sequence[float],
    decays: Sequence[float],
    betas: tuple[float, float],
    eps: float,
    step_count: int,
) -> None:
    """See `Engine.adam_step`."""
    rates = step_rates(learning_rates, betas, step_count)
    numbers = upload([*rates, *decays], groups[0][0].device)
    CudaQueuedSteps.adam_step(groups, numbers[: len(rates)], numbers[len(rates) :], betas, eps, None)


def update_statistics(
    records: Sequence[Tensor],
    view: TriangleStatistics,
    views: int,
    epoch_starts: bool | Tensor,
    halted: Tensor | None = None,
) -> None:
    """See `etsplat.ops.soup_statistics`."""
    count, device = len(records[0]), records[0].device
    seen_now = view.max_weight[0], view.screen_size[0], view.inradius[0]
    starts = epoch_starts if isinstance(epoch_starts, Tensor) else upload([epoch_starts], device)
    going_on = torch.zeros((), dtype=torch.int32, device=device) if halted is None else halted
    launch_each(_STATISTICS, "soup_statistics", count, (count, *seen_now, *records, views, starts, going_on))


class Repeated:
    """Calls a function the first time, captures it the second time, and replays the graph from then on.

    The function must do the same on every call and read what changes from device memory; what it allocates stays
    allocated for the graph. The first call compiles kernels and fills caches, which a capture must not.
    """

    def __init__(self, body: Callable[[], None], pool: Any) -> None:
        """Captures nothing yet.

        Args:
            body: the function.
            pool: from the backend's `memory_pool`. Graphs of one pool work in the same memory: they are replayed on one
                stream, and none reads what another has left there.
        """
        self._body = body
        self._pool = pool
        self._called = False
        self._replay: Callable[[], None] | None = None

    def __call__(self) -> None:
        """Queue the launches; nothing waits for them."""
        if self._replay is not None:
            self._replay()
        elif self._called:
            self._replay = backend().capture(self._body, self._pool)
        else:
            backend().warm_up(self._body)
            self._called = True


class CudaQueuedSteps:
    """Steps that the device repeats by itself; what changes from one to the next is read from its memory.

    `halted` is () int32 in device memory: where it is not 0, nothing is updated.
    """

    update_statistics = staticmethod(update_statistics)
    colors_adam = staticmethod(colors_adam)
    repeated = Repeated
    """What queues the work of a function each time it is called, by and by without calling the function."""

    def memory_pool(self) -> Any:
        """Memory that steps of several kinds can share."""
        return backend().memory_pool()

    def verdict(self, loss: Tensor, position: Tensor, losses: Tensor, halted: Tensor) -> None:
        """Queue: keep the loss at `position`, move on if the step counts, and halt otherwise.

        A step counts if its buffers were large enough and its loss is finite.
        """
        launch(_STEP, "step_verdict", 1, 1, (loss, overflow_flag(loss.device), position, losses, halted))

    def repair(self, device: torch.device) -> bool:
        """Whether a step found too little room, which the next ones will have. Waits for the device."""
        return repair_overflow(device)

    @staticmethod
    def adam_step(
        groups: Sequence[AdamGroup],
        rates: Tensor,
        decays: Tensor | None,
        betas: tuple[float, float],
        eps: float,
        halted: Tensor | None,
    ) -> None:
        """As `Engine.adam_step`, with `Adam.rates` (P + 1,) and decays (P,) float32 in device memory.

        Without decays there are none, and without `halted` it never halts.
        """
        first_beta, second_beta = betas
        constants = 1 - first_beta, second_beta, 1 - second_beta, eps
        table_class = struct_class("cuda/adam.cu", "AdamParameters")
        most = len(table_class().sizes)
        for first in range(0, len(groups), most):
            chosen = groups[first : first + most]
            sizes = [group[0].numel() for group in chosen]
            widths = [max(1, math.prod(group[0].shape[1:])) for group in chosen]
            table = table_class(*map(list, zip(*chosen, strict=True)), sizes, widths)
            grid = sum(blocks(size, _ADAM_ELEMENTS) for size in sizes)
            numbers = rates[first:], rates[len(groups) :], None if decays is None else decays[first:]
            arguments = (table, len(chosen), *numbers, *constants, halted)
            launch(_ADAM, "adam_step", grid, _ADAM_THREADS, arguments)
