"""In which order a run sees its views, and every other random choice of the run."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor


class ViewSampler:
    """Shuffled epochs: each view once, without replacement, then all again in a new order.

    Owns the run's only random generator, so that a checkpoint of this object fixes all that is random in the rest.
    """

    def __init__(self, views: Sequence[int], generator: torch.Generator) -> None:
        self._views = torch.tensor(list(views), dtype=torch.int64)
        self._generator = generator
        self._order = self._views[:0]
        self._position = 0

    def show(self, views: Sequence[int], *, anew: bool) -> None:
        """From the next epoch on, some views alone.

        Args:
            views: which; one at least.
            anew: whether that epoch begins now.
        """
        self._views = torch.tensor(list(views), dtype=torch.int64)
        if anew:
            self._order, self._position = self._views[:0], 0

    def next_view(self) -> int:
        """The index of the next view."""
        if self._position == len(self._order):
            self._order = self._views[torch.randperm(len(self._views), generator=self._generator)]
            self._position = 0
        self._position += 1
        return int(self._order[self._position - 1])

    @property
    def epoch_starts(self) -> bool:
        """Whether the view that `next_view` gave last is the first of an epoch."""
        return self._position == 1

    @property
    def generator(self) -> torch.Generator:
        """For whatever else the run chooses at random."""
        return self._generator

    def upcoming(self, count: int) -> list[int]:
        """At most `count` of the views that come next in this epoch."""
        return self._order[self._position : self._position + count].tolist()

    def background(self) -> Float[Tensor, "1 3"]:
        """A random colour, uniform in [0, 1)^3."""
        return torch.rand(1, 3, generator=self._generator)

    def state(self) -> dict[str, Tensor]:
        """Everything that decides what comes next."""
        return {
            "generator": self._generator.get_state(),
            "order": self._order,
            "position": torch.tensor(self._position),
        }

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Continues where `state` was taken."""
        self._generator.set_state(state["generator"])
        self._order = state["order"]
        self._position = int(state["position"])
