"""What the photos that are kept aside say of a run, and its best state by them.

They are measured at every evaluation. Of the states that are drawn as the model is drawn now, the one that explains
them best is kept: what is soft before the opaque finish, has fewer bands of colours or was fitted to halved photos,
does not compete with what comes after. It is the result in the place of the last state if that is worse by more than
`MARGIN`: what lies within is noise, and the last state has the smallest steps behind it.
"""

import math
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from etsplat.model.model import Model
from etsplat.optim.gauge import Gauge
from etsplat.optim.objective import Objective

MARGIN = 0.25
"""By so many dB the last state may be worse than the best and is still the result."""

M = TypeVar("M", bound=Model)


@dataclass(frozen=True)
class Outcome(Generic[M]):
    """What a run gives.

    Attributes:
        model: the result.
        iteration: whose state it is.
        views: number of photos that were kept aside.
        psnr: of the result on these, in dB; None if there are none.
        last_psnr: of the last state on them.

    Example:
        >>> mesh = etsplat.TriangleMesh.from_mesh(*etsplat.icosphere(1), colors=0.7, opacity=0.98, sigma=0.25)
        >>> outcome = etsplat.Outcome(mesh, iteration=800, views=3, psnr=27.5, last_psnr=27.0)
        >>> outcome.note.split("; ")[-1]
        'the result is of iteration 800'
    """

    model: M
    iteration: int
    views: int = 0
    psnr: float | None = None
    last_psnr: float | None = None

    @property
    def note(self) -> str | None:
        """A sentence where the result is not the last state."""
        if self.psnr is None or self.psnr == self.last_psnr:
            return None
        photos = "photo" if self.views == 1 else f"{self.views} photos"
        return (
            f"the run got worse towards its end: the {photos} kept aside had {self.psnr:.2f} dB after iteration "
            f"{self.iteration:,} and {self.last_psnr:.2f} dB at last; the result is of iteration {self.iteration:,}"
        )

    @property
    def metrics(self) -> dict[str, Any]:
        """For metrics.json; nothing where no photos were kept aside."""
        if self.psnr is None:
            return {}
        numbers = {"watched_views": self.views, "watched_psnr": self.psnr, "watched_psnr_last": self.last_psnr}
        return {**numbers, "result_iteration": self.iteration}


@dataclass(frozen=True)
class _Best:
    iteration: int
    psnr: float
    model: dict[str, Tensor]


class Watch:
    """Measures the photos that are kept aside, and keeps the best state."""

    def __init__(self, gauge: Gauge, objective: Objective, look: Callable[[int], object]) -> None:
        """Has seen nothing yet.

        Args:
            gauge: of these photos.
            objective: what the run minimises.
            look: how the model is drawn after an iteration; comparable.
        """
        self._gauge, self._objective, self._look = gauge, objective, look
        self._best: _Best | None = None

    def observe(self, model: Model, iteration: int) -> dict[str, float]:
        """Measures a state, and keeps it if it is the best; returns "watched_loss" and "watched_psnr"."""
        measured = self._gauge.measure(model, self._objective)
        psnr = measured.psnr
        if math.isfinite(psnr) and psnr > self._to_beat(iteration):
            self._best = None  # first, so that there are not two of them beside the model
            state = {name: tensor.clone() for name, tensor in model.state().items()}
            self._best = _Best(iteration, psnr, state)
        return {"watched_loss": measured.loss, "watched_psnr": psnr}

    def outcome(self, model: M, iteration: int, finish: Callable[[M], None]) -> Outcome[M]:
        """The best state, if it is better than the present one by more than the margin, or else this.

        Args:
            model: at the end; not changed.
            iteration: the last.
            finish: does to an earlier state what was done to the last after its step.
        """
        last, views = self._gauge.measure(model, self._objective).psnr, self._gauge.views
        best = self._best
        if best is not None and self._to_beat(iteration) > last + MARGIN:
            earlier = copy(model)
            earlier.load_state({name: tensor.clone() for name, tensor in best.model.items()})
            finish(earlier)
            psnr = self._gauge.measure(earlier, self._objective).psnr
            if psnr > last + MARGIN:
                return Outcome(earlier, best.iteration, views, psnr, last)
        return Outcome(model, iteration, views, last, last)

    def _to_beat(self, iteration: int) -> float:
        """The best score of states that are drawn as after an iteration."""
        best = self._best
        return best.psnr if best is not None and self._look(best.iteration) == self._look(iteration) else -math.inf

    def state(self) -> dict[str, Tensor]:
        """The best state and its score, by name, for a checkpoint."""
        if self._best is None:
            return {}
        place = torch.tensor([self._best.iteration, self._best.psnr], dtype=torch.float64)
        return {"best": place, **{f"model.{name}": tensor for name, tensor in self._best.model.items()}}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continues where `state` was taken."""
        self._best = None
        if "best" in state:
            iteration, psnr = state["best"].tolist()
            model = {name.removeprefix("model."): tensor for name, tensor in state.items() if name != "best"}
            self._best = _Best(int(iteration), psnr, model)
