"""Steps of what a step of a run sees only a part of, such as the poses of the photos that it draws.

Each row has a clock of its own, and one length for all of its numbers: v, the mean of squares of its gradient g over
its own visits. Adam's v, one for each number, makes directions that photos hardly show as fast as those they show well,
by noise alone; and over a run it keeps what the first visits saw.

    v <- b v + (1 - b) mean(g^2)
    p <- p - lr g / sqrt(v / (1 - b^t))
"""

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

MEMORY = 0.7
"""b: a row's length is that of its last few visits."""


class VisitSteps:
    """Of the rows of one parameter; those without a gradient in a step stay, with all that is known of them."""

    def __init__(self, parameter: Float[Tensor, "P k"]) -> None:
        """No row was visited yet.

        Args:
            parameter: changed in place.
        """
        self._parameter = parameter
        self._squares, self._visits = parameter.new_zeros(2, len(parameter)).unbind()

    @torch.no_grad()
    def step(self, rate: float | Tensor, halted: Tensor | None = None) -> None:
        """Moves the rows that have a gradient.

        Args:
            rate: by how much, where a gradient is as long as its mean.
            halted: () where it is not 0 nothing is changed.
        """
        gradient = self._parameter.grad
        assert gradient is not None
        squares = gradient.square().mean(dim=1)
        seen = squares != 0  # NaN too, so that it is found
        if halted is not None:
            seen = seen & (halted == 0)
        self._visits.add_(seen)
        self._squares.add_(torch.where(seen, (1 - MEMORY) * (squares - self._squares), 0.0))
        root = (self._squares / (1 - MEMORY**self._visits)).sqrt()
        self._parameter.sub_(torch.where(seen[:, None], rate * gradient / root[:, None], 0.0))

    def state(self) -> dict[str, Tensor]:
        """What the next steps depend on, by name."""
        return {"squares": self._squares, "visits": self._visits}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continues where `state` was taken."""
        self._squares.copy_(state["squares"])
        self._visits.copy_(state["visits"])
