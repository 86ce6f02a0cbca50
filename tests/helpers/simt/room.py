"""Too little room for a step's pairs, so that it overflows and is repeated."""

from collections.abc import Hashable, Iterator
from contextlib import contextmanager

import pytest
import torch

from etsplat.engines.cuda import capacity
from etsplat.engines.cuda import steps as cuda_steps
from etsplat.engines.cuda.capacity import repair_overflow
from etsplat.optim import step_queue


@contextmanager
def room_for_16_pairs() -> Iterator[list[bool]]:
    """Steps captured within have room for 16 pairs at first; yields whether each look for an overflow repaired one."""
    repairs: list[bool] = []

    def repair(device: torch.device) -> bool:
        repairs.append(repair_overflow(device))
        return repairs[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cuda_steps, "repair_overflow", repair)
        patch.setattr(capacity, "_seen", {})
        patch.setattr(capacity, "_FIRST_ROOM", 16)
        patch.setattr(capacity, "_FIRST_PER_TRIANGLE", 0)
        yield repairs


@contextmanager
def second_step_overflows(queue: step_queue.StepQueue, device: torch.device) -> Iterator[list[Hashable]]:
    """The queue's second step finds too little room; yields the kind of every step made, repeated ones included."""
    flag, gradients = capacity.overflow_flag(device), queue._gradients
    kinds: list[Hashable] = []

    def overflowing(row: torch.Tensor, kind: Hashable) -> torch.Tensor:
        kinds.append(kind)
        if len(kinds) == 2:
            flag.fill_(1000)
        return gradients(row, kind)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(queue, "_gradients", overflowing)
        yield kinds
    assert int(flag) == 0
