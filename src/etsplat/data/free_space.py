"""Where nothing is: in front of what depth maps show from all sides (Curless and Levoy 1996)."""

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.data.dataset import Dataset
from etsplat.data.depth_points import on_map
from etsplat.data.visual_hull import Distance

TRUNCATED = 0.1
"""Nothing counts as farther in front of a surface than this; and what is farther behind one is hidden, so that its map
does not tell."""

ASKED = 2
"""Maps that must tell of a point."""


def free_space(dataset: Dataset, depths: Mapping[int, Float[Tensor, "H W"]]) -> Distance:
    """How far points are in front of what the maps show, in the mean: positive where nothing is.

    Args:
        dataset: whose views they are.
        depths: by view, depths along the optical axis, 0 where not known.

    Returns:
        A function of points (N, 3) in the frame of the data set; -`TRUNCATED` where fewer than `ASKED` maps tell.
    """

    def ahead(points: Tensor) -> Tensor:
        total, asked = torch.zeros(len(points)), torch.zeros(len(points))
        for view, shown in depths.items():
            surface, depth = on_map(dataset, view, shown, points.double())
            before = (surface - depth).float()
            tells = (surface > 0) & (before > -TRUNCATED)
            total += torch.where(tells, before.clamp_max(TRUNCATED), 0.0)
            asked += tells
        return torch.where(asked >= ASKED, total / asked.clamp_min(1), -TRUNCATED)

    return ahead
