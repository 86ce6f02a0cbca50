"""A trainer bound to an engine, for tests that compare engines step by step."""

from collections.abc import Callable
from typing import Any

import torch

import etsplat
from etsplat.optim.step_queue import StepQueue
from etsplat.optim.trainer import Trainer


class OnEngine:
    """What a trainer does, always on one engine."""

    def __init__(self, name: str, make: Callable[[], Trainer[Any]]) -> None:
        self.engine = name
        with etsplat.engine(name):
            self.trainer = make()

    @property
    def model(self) -> Any:
        return self.trainer.model

    @property
    def queue(self) -> StepQueue:
        """Of a trainer on engine "cuda"."""
        assert self.trainer._stepper.queue is not None
        return self.trainer._stepper.queue

    def advance(self, first: int, last: int) -> list[float]:
        with etsplat.engine(self.engine):
            return self.trainer.advance(first, last)

    def refine(self, iteration: int) -> int:
        with etsplat.engine(self.engine):
            return self.trainer.refine(iteration)

    def run(self, last: int, together: int = 1 << 30) -> list[float]:
        """The losses of all steps up to iteration `last`, queued so many at a time, with edits in between."""
        losses: list[float] = []
        while len(losses) < last:
            losses += self.advance(len(losses) + 1, min(last, len(losses) + together))
            self.refine(len(losses))
        return losses

    def step_again(self, kind: Any) -> None:
        """The step once more, as it is captured, of the row at which the queue stands."""
        with etsplat.engine(self.engine):
            self.queue._step(kind)

    def state(self) -> dict[str, torch.Tensor]:
        """A copy, on the CPU."""
        return {name: tensor.cpu().clone() for name, tensor in self.trainer.state().items()}


def same_bits(first: OnEngine, second: OnEngine) -> None:
    """Asserts that two trainers are in the same state."""
    state, expected = first.state(), second.state()
    assert state.keys() == expected.keys()
    assert [name for name, tensor in state.items() if not torch.equal(tensor, expected[name])] == []
