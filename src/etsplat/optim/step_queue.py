"""Optimization steps that run on the device one after the other, without the host looking in between."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.engines.choice import queued_steps

MAX_STEPS = 256
"""Steps that can be queued at a time."""


class RowLayout:
    """Named groups of numbers, side by side.

    Attributes:
        width: numbers in a row.
    """

    def __init__(self, **counts: int) -> None:
        """Takes how many numbers each group has, in the order in which they lie."""
        self._counts = counts
        self.width = sum(counts.values())

    def pack(self, **groups: Sequence[float]) -> list[float]:
        """A row of the groups.

        Raises:
            ValueError: other groups than there are, or of another size.
        """
        given = {name: len(group) for name, group in groups.items()}
        if given != self._counts:
            raise ValueError(f"groups must be {self._counts}, got {given}")
        return [float(number) for name in self._counts for number in groups[name]]

    def unpack(self, row: Float[Tensor, " W"]) -> dict[str, Tensor]:
        """The groups of a row by name, as views of it: nothing is launched for them."""
        return dict(zip(self._counts, row.split(list(self._counts.values())), strict=True))


@dataclass(frozen=True)
class QueuedStep:
    """A step to come.

    Attributes:
        row: the numbers that it reads.
        kind: steps of one kind launch the same kernels on the same memory: one graph.
        prepare: queues what the step needs besides its row, such as the upload of a photo.
    """

    row: list[float]
    kind: Hashable = None
    prepare: Callable[[], object] = lambda: None


class StepQueue:
    """Repeats steps whose inputs, whatever changes from step to step, are a row of numbers each.

    The rows are uploaded together; a step reads the row at a position in device memory, and moves the position on. A
    step that does not count (csrc/cuda/step.cu) leaves everything as it was, and so do all steps queued behind it; the
    host finds the position where it stopped.
    """

    def __init__(
        self,
        gradients: Callable[[Tensor, Hashable], Tensor],
        commit: Callable[[Tensor, Tensor], None],
        width: int,
        device: torch.device,
    ) -> None:
        """Captures nothing yet.

        Args:
            gradients: computes the gradients of the optimizer's parameters from a row (width,) for a kind of steps and
                returns the loss; it must not wait for the device.
            commit: takes the step, from the same row, where () int32 `halted` in device memory is 0, and changes
                nothing where it is not.
            width: numbers in a row.
            device: where it runs.
        """
        self._gradients = gradients
        self._commit = commit
        self._queued = torch.zeros((MAX_STEPS, width), pin_memory=device.type == "cuda")
        self._rows = torch.zeros((MAX_STEPS, width), device=device)
        self._position = torch.zeros(1, dtype=torch.int64, device=device)
        self._losses = torch.zeros(MAX_STEPS, device=device)
        self._halted = torch.zeros((), dtype=torch.int32, device=device)
        self._engine = queued_steps(self._rows)
        self._repeated: dict[Hashable, Callable[[], None]] = {}
        self.restart()

    def restart(self) -> None:
        """To be called when a tensor that the steps use was replaced: captures anew."""
        self._repeated.clear()
        self._pool = self._engine.memory_pool()  # torch takes no new graphs into a pool that has lost all of its own

    def run(self, steps: Sequence[QueuedStep]) -> list[float]:
        """Makes at most MAX_STEPS steps.

        Returns:
            The loss before each step. They end with one that is not finite where that happened; its step and those
            after it were not made.
        """
        self._queued[: len(steps)] = torch.tensor([step.row for step in steps])
        self._rows.copy_(self._queued, non_blocking=True)
        self._position.zero_()
        done = 0
        while done < len(steps):
            self._halted.zero_()
            for step in steps[done:]:
                step.prepare()
                self._graph(step.kind)()
            done = int(self._position)  # waits for the device
            if done == len(steps) or not self._engine.repair(self._rows.device):
                break
            self.restart()
        return self._losses[: min(done + 1, len(steps))].tolist()

    def _graph(self, kind: Hashable) -> Callable[[], None]:
        if kind not in self._repeated:
            self._repeated[kind] = self._engine.repeated(lambda: self._step(kind), self._pool)
        return self._repeated[kind]

    def _step(self, kind: Hashable) -> None:
        row = self._rows.index_select(0, self._position)[0]
        loss = self._gradients(row, kind)
        self._engine.verdict(loss, self._position, self._losses, self._halted)
        self._commit(row, self._halted)
