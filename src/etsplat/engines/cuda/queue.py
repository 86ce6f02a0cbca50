"""Steps as CUDA graphs: see `QueuedSteps`."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from etsplat.engines.cuda.adam import adam_step_queued
from etsplat.engines.cuda.capacity import overflow_flag, repair_overflow
from etsplat.engines.cuda.graph import Repeated
from etsplat.engines.cuda.launch import backend, launch
from etsplat.engines.cuda.program import Program
from etsplat.engines.cuda.soup_statistics import update_statistics_queued

_PROGRAM = Program("step.cu", contract=False)


class CudaQueuedSteps:
    """What a captured step needs besides the operations."""

    adam_step = staticmethod(adam_step_queued)
    update_statistics = staticmethod(update_statistics_queued)

    def memory_pool(self) -> Any:
        """See `QueuedSteps.memory_pool`."""
        return backend().memory_pool()

    def repeated(self, body: Callable[[], None], pool: Any) -> Callable[[], None]:
        """See `QueuedSteps.repeated`."""
        return Repeated(body, pool)

    def verdict(self, loss: Tensor, position: Tensor, losses: Tensor, halted: Tensor) -> None:
        """See `QueuedSteps.verdict`; a step counts if its buffers were large enough and its loss is finite."""
        launch(_PROGRAM, "step_verdict", 1, 1, (loss, overflow_flag(loss.device), position, losses, halted))

    def repair(self, device: torch.device) -> bool:
        """See `QueuedSteps.repair`."""
        return repair_overflow(device)
