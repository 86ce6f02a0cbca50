"""What is remembered of each triangle from view to view, in plain PyTorch."""

from collections.abc import Sequence

import torch
from torch import Tensor

from etsplat.core.rasterization import TriangleStatistics

_VISIBLE_INRADIUS = 1.0


def update_statistics(
    records: Sequence[Tensor], view: TriangleStatistics, views: int, epoch_starts: bool | Tensor
) -> None:
    """Update the records in place; see `etsplat.ops.soup_statistics`."""
    importance, screen_size, seen, trial = records
    seen_now = view.max_weight[0], view.screen_size[0], view.inradius[0]
    torch.maximum(importance, seen_now[0], out=importance)
    torch.maximum(screen_size, seen_now[1], out=screen_size)
    running = trial < views
    if not epoch_starts:
        running &= trial > 0
    seen += running & (seen_now[2] > _VISIBLE_INRADIUS)
    trial += running
