"""Optimization steps that run on the device one after the other, without the host looking in between."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from etsplat.cuda.graph import Repeated
from etsplat.cuda.launch import launch
from etsplat.cuda.program import Program
from etsplat.ops._raster_capacity import overflow_flag, repair_overflow
from etsplat.ops.adam import Adam

_PROGRAM = Program("step.cu", contract=False)
MAX_STEPS = 256
"""Steps that can be queued at a time."""


class StepQueue:
    """Repeats a step whose inputs, whatever changes from step to step, are a row of numbers each.

    The rows are uploaded together; a step reads the row at a position in device memory, and moves the position on. A
    step that does not count (csrc/cuda/step.cu) leaves everything as it was, and so do all steps queued behind it; the
    host finds the position where it stopped.
    """

    def __init__(self, gradients: Callable[[Tensor], Tensor], adam: Adam, width: int, device: torch.device) -> None:
        """Captures nothing yet.

        Args:
            gradients: computes the gradients of the optimizer's parameters from a row (width,) and returns the loss;
                it must not wait for the device. The last numbers of a row are the optimizer's `rates`.
            adam: the optimizer, of engine "cuda".
            width: numbers in a row.
            device: where it runs.
        """
        self._gradients = gradients
        self._adam = adam
        self._queued = torch.zeros((MAX_STEPS, width), pin_memory=device.type == "cuda")
        self._rows = torch.zeros((MAX_STEPS, width), device=device)
        self._position = torch.zeros(1, dtype=torch.int64, device=device)
        self._losses = torch.zeros(MAX_STEPS, device=device)
        self._halted = torch.zeros((), dtype=torch.int32, device=device)
        self._repeated = Repeated(self._step)

    def restart(self) -> None:
        """To be called when a tensor that the step uses was replaced: captures anew."""
        self._repeated = Repeated(self._step)

    def run(self, rows: Sequence[Sequence[float]]) -> list[float]:
        """Makes a step for each of at most MAX_STEPS rows.

        Returns:
            The loss before each step. They end with one that is not finite where that happened; its step and those
            after it were not made.
        """
        self._queued[: len(rows)] = torch.tensor(rows)
        self._rows.copy_(self._queued, non_blocking=True)
        self._position.zero_()
        done = 0
        while done < len(rows):
            for _ in range(done, len(rows)):
                self._repeated()
            done = int(self._position)  # waits for the device
            if done == len(rows) or not repair_overflow(self._rows.device):
                break
            self.restart()
        return self._losses[: min(done + 1, len(rows))].tolist()

    def _step(self) -> None:
        row = self._rows.index_select(0, self._position)[0]
        loss = self._gradients(row)
        overflow = overflow_flag(self._rows.device)
        launch(_PROGRAM, "step_verdict", 1, 1, (loss, overflow, self._position, self._losses, self._halted))
        self._adam.step_on_device(row[-len(self._adam.parameters) - 1 :], self._halted)
