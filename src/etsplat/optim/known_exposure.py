"""Exposures that an earlier run learned, for one that goes on with its photos."""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.optim.exposure import Exposure
from etsplat.optim.schedules import NEVER


class KnownExposure(Exposure):
    """Each photo's colour matrix as it is given; nothing is learned."""

    def __init__(self, matrices: Mapping[int, Float[Tensor, "3 3"]]) -> None:
        """Takes the matrices of all training views, by their index."""
        super().__init__(NEVER, rate=0.0, weights=(0.0, 0.0))
        self._given = matrices

    def start(self, views: Sequence[int], batch: int, like: Tensor) -> None:
        """Of these views, all in `matrices`."""
        super().start(views, batch, like)
        self._matrices = torch.stack([self._given[view].to(like) for view in views])
        self.learned = True

    def matrix(self, index: Tensor) -> Float[Tensor, "3 3"]:
        """Of a photo; see `Exposure.matrix`."""
        return self._matrices.index_select(0, self._rows.index_select(0, index))[0]
