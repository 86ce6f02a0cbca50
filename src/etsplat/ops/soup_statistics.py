"""What is remembered of each triangle of a soup from view to view; optim/densification.py says what for.

    importance = max(importance, largest blend weight)      seen += on trial and larger than a pixel
    screen size = max(screen size, of this view)            trial += on trial

A triangle is on trial for as many views as there are, from the first view of an epoch on.
"""

from collections.abc import Sequence

from torch import Tensor

from etsplat.core.rasterization import TriangleStatistics
from etsplat.engines.choice import engine_for, queued_steps


def update_statistics(
    records: Sequence[Tensor],
    view: TriangleStatistics,
    views: int,
    epoch_starts: bool | Tensor,
    halted: Tensor | None = None,
) -> None:
    """Take a view into the records of N triangles, in place.

    Args:
        records: (N,) importance and screen size, floating point; views seen and views of the trial, int32.
        view: its statistics, (1, N).
        views: length of an epoch.
        epoch_starts: whether the view is the first of an epoch; in a queued step (1,) float32 in device memory, 0 or 1.
        halted: of a queued step, () int32 in device memory; nothing is updated where it is not 0.
    """
    if halted is None:
        engine_for(records[0]).update_statistics(records, view, views, epoch_starts)
    else:
        queued_steps(records[0]).update_statistics(records, view, views, epoch_starts, halted)
