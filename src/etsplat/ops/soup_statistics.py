"""What is remembered of each triangle of a soup from view to view; optim/densification.py says what for.

    importance = max(importance, largest blend weight)      seen += on trial and larger than a pixel
    screen size = max(screen size, of this view)            trial += on trial

A triangle is on trial for as many views as there are, from the first view of an epoch on.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from etsplat.core.rasterization import TriangleStatistics
from etsplat.cuda.launch import blocks, launch
from etsplat.cuda.program import Program

_PROGRAM = Program("soup_statistics.cu", contract=False)
_THREADS = 256
_VISIBLE_INRADIUS = 1.0


def update_statistics(
    records: Sequence[Tensor],
    view: TriangleStatistics,
    views: int,
    epoch_starts: bool,
) -> None:
    """Take a view into the records of N triangles, in place.

    Args:
        records: (N,) importance and screen size, floating point; views seen and views of the trial, int32.
        view: its statistics, (1, N).
        views: length of an epoch.
        epoch_starts: whether the view is the first of an epoch.
    """
    importance, screen_size, seen, trial = records
    seen_now = view.max_weight[0], view.screen_size[0], view.inradius[0]
    torch.maximum(importance, seen_now[0], out=importance)
    torch.maximum(screen_size, seen_now[1], out=screen_size)
    running = trial < views
    if not epoch_starts:
        running &= trial > 0
    seen += running & (seen_now[2] > _VISIBLE_INRADIUS)
    trial += running


def update_statistics_on_device(
    records: Sequence[Tensor], view: TriangleStatistics, views: int, epoch_starts: Tensor, halted: Tensor
) -> None:
    """As ``update_statistics``, by engine "cuda", so that a CUDA graph can capture and repeat it.

    Args:
        records: as there, float32 and int32.
        view: as there.
        views: as there.
        epoch_starts: (1,) float32 in device memory, 0 or 1.
        halted: () int32 in device memory; nothing is updated where it is not 0.
    """
    count = len(records[0])
    seen_now = view.max_weight[0], view.screen_size[0], view.inradius[0]
    arguments = (count, *seen_now, *records, views, epoch_starts, halted)
    launch(_PROGRAM, "soup_statistics", blocks(count, _THREADS), _THREADS, arguments)
