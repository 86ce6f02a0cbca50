"""The GPU engine's side of `update_statistics`: csrc/cuda/soup_statistics.cu."""

from collections.abc import Sequence

import torch
from torch import Tensor

from etsplat.core.rasterization import TriangleStatistics
from etsplat.engines.cuda.launch import blocks, launch
from etsplat.engines.cuda.program import Program
from etsplat.engines.cuda.transfer import upload

_PROGRAM = Program("soup_statistics.cu", contract=False)
_THREADS = 256


def update_statistics(records: Sequence[Tensor], view: TriangleStatistics, views: int, epoch_starts: bool) -> None:
    """See `Engine.update_statistics`."""
    device = records[0].device
    going_on = torch.zeros((), dtype=torch.int32, device=device)
    update_statistics_queued(records, view, views, upload([epoch_starts], device), going_on)


def update_statistics_queued(
    records: Sequence[Tensor], view: TriangleStatistics, views: int, epoch_starts: Tensor, halted: Tensor
) -> None:
    """See `QueuedSteps.update_statistics`."""
    count = len(records[0])
    seen_now = view.max_weight[0], view.screen_size[0], view.inradius[0]
    arguments = (count, *seen_now, *records, views, epoch_starts, halted)
    launch(_PROGRAM, "soup_statistics", blocks(count, _THREADS), _THREADS, arguments)
