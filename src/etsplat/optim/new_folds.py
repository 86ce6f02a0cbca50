"""A strategy for meshes whose vertices are fitted with nothing that keeps faces in order: no new folds."""

from collections.abc import Mapping

import torch
from jaxtyping import Bool
from torch import Tensor

from etsplat.geometry.held_back import held_back
from etsplat.ops.adam import Adam
from etsplat.optim.schedules import NEVER
from etsplat.optim.strategies import Strategy


class NoNewFolds(Strategy):
    """Vertices of faces that have come to cut through others go back to where they were when it last looked."""

    _before: Tensor

    def __init__(self, spared: Bool[Tensor, " F"], every: int, last: int) -> None:
        """Takes when it looks, and where not.

        Args:
            spared: (F,) on the CPU, faces that may cut through others, as they do at the start.
            every: iterations between two looks.
            last: the last iteration of the run, after which it looks too.
        """
        self._spared, self._every, self._last = spared, every, last

    def start(self, model: object, adam: Adam, views: int, generator: torch.Generator) -> None:
        """Where vertices are now, they may be."""
        super().start(model, adam, views, generator)
        self._before = self.model.vertices.detach().cpu().clone()

    def next_edit(self, iteration: int) -> int:
        """The next multiple of `every`, or the last iteration."""
        return min(-(-iteration // self._every) * self._every, self._last) if iteration <= self._last else NEVER

    def edit(self, iteration: int) -> bool:
        """Brings vertices back; none is added."""
        if self.next_edit(iteration) == iteration:
            vertices = self.model.vertices.detach()
            self._before = held_back(vertices.cpu(), self._before, self.model.topology.faces.cpu(), self._spared)
            vertices.copy_(self._before)
        return False

    def state(self) -> dict[str, Tensor]:
        """Where vertices were."""
        return {"before": self._before}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Goes on from there."""
        self._before = state["before"]
