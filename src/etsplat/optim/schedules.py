"""How weights and learning rates change over a run. Iterations are counted from 1 to `iterations`."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from etsplat.core.validation import check_number

NEVER = 1 << 62
"""An iteration that no run gets to."""

Scheduled = float | Callable[[int], float]
"""A number, or a function of the iteration."""


def at(value: Scheduled, iteration: int) -> float:
    """What something scheduled is at an iteration."""
    return value(iteration) if callable(value) else value


def _never(_iteration: int) -> int:
    """A name, so that schedules can be pickled."""
    return 0


@dataclass(frozen=True)
class Schedule:
    """What changes over a run and is not learned.

    Attributes:
        rates: Adam's learning rates, by parameter.
        values: parameters of one number that are set instead of learned, by name.
        appearance: how the model is drawn, by iteration (0 is the start); None for what the model says.
        halvings: how often the photos are halved, by iteration.
        calm_from: by name of a parameter, the iteration from which on it is one of `Adam.calmed`. What Adam knows of
            its gradients begins anew there, as they are then of another kind.
        views: indices of those training views that steps show, by iteration; None for all. Where they change an epoch
            of the others ends.

    Raises:
        ValueError: a rate is negative, or no number.

    Example:
        >>> falling = etsplat.Schedule({"vertices": lambda k: 1e-2 * etsplat.exponential_decay(k, 1000, 0.1)})
        >>> round(falling.rates["vertices"](1000), 6)
        0.001
    """

    rates: Mapping[str, Scheduled]
    values: Mapping[str, Scheduled] = field(default_factory=dict)
    appearance: Callable[[int], Any] | None = None
    halvings: Callable[[int], int] = _never
    calm_from: Mapping[str, int] = field(default_factory=dict)
    views: Callable[[int], Sequence[int]] | None = None

    def __post_init__(self) -> None:
        for name, rate in self.rates.items():
            if not callable(rate):
                check_number(f"rates[{name}]", rate, 0)


def begun_anew(iteration: int, first: int, betas: tuple[float, float]) -> float:
    """Factor on a rate that lets Adam's steps be those of a run that began at iteration `first`, with moments of 0.

    Args:
        iteration: 1 or more, and no less than `first`.
        first: the iteration of the first step with the new moments.
        betas: of Adam.
    """

    def correction(steps: int) -> float:
        return math.sqrt(1 - betas[1] ** steps) / (1 - betas[0] ** steps)

    return correction(iteration - first + 1) / correction(iteration)


def regularization_weight(iteration: int, iterations: int, hold: int, final: float = 0.0) -> float:
    """The global weight gamma of the regularizers, paper section 3.3: cosine decay from 1 to `final`.

    gamma = 1 up to iteration `hold`, then final + (1 - final) (1 + cos(pi (iteration - hold) / (iterations - hold)))
    / 2, which is `final` at the last iteration. The paper: hold 500 of 30,000, final 0.

    Args:
        iteration: 1..iterations.
        iterations: length of the run.
        hold: last iteration at full weight, 0 <= hold. A run no longer than `hold` keeps 1 throughout.
        final: in [0, 1].

    Example:
        >>> [etsplat.regularization_weight(k, 1000, hold=500) for k in (1, 500, 750, 1000)]
        [1.0, 1.0, 0.5, 0.0]
    """
    if iteration <= hold:
        return 1.0
    cosine = 0.5 * (1.0 + math.cos(math.pi * (iteration - hold) / (iterations - hold)))
    return final + (1.0 - final) * cosine


def limited_iterations(iterations: int, max_epochs: int | None, views: int, batch: int = 1) -> int:
    """The length of a run that sees no view more often than `max_epochs` times.

    Args:
        iterations: at most so many.
        max_epochs: None for no limit.
        views: number of training views, >= 1.
        batch: how many of them an iteration sees.
    """
    return iterations if max_epochs is None else min(iterations, max(1, max_epochs * views // batch))


def exponential_decay(iteration: int, iterations: int, ratio: float) -> float:
    """Factor on a learning rate: falls exponentially from 1 at the first iteration to `ratio` at the last.

    Args:
        iteration: 1..iterations.
        iterations: length of the run.
        ratio: factor at the last iteration, > 0.

    Example:
        >>> [round(etsplat.exponential_decay(k, 101, 0.01), 4) for k in (1, 51, 101)]
        [1.0, 0.1, 0.01]
    """
    if iterations <= 1:
        return 1.0
    return ratio ** ((iteration - 1) / (iterations - 1))


def late_decay(iteration: int, iterations: int, ratio: float) -> float:
    """Factor on a learning rate: stays high for longer than `exponential_decay`, then falls below it.

    ratio + (1 - ratio) ((1 + cos(pi t)) / 2)^2, t from 0 at the first iteration to 1 at the last. Its mean over a run
    is 3/8, where an exponential that ends at 0.02 has a quarter: what travels gets half as far again.

    Args:
        iteration: 1..iterations.
        iterations: length of the run.
        ratio: factor at the last iteration, >= 0.
    """
    done = (iteration - 1) / max(iterations - 1, 1)
    return ratio + (1.0 - ratio) * (0.5 * (1.0 + math.cos(math.pi * done))) ** 2


def coarse_level(iteration: int, iterations: int, levels: int, until: float) -> int:
    """How many times the pictures are halved: `levels` at first, one less after each equal part, 0 from `until` on.

    Args:
        iteration: 1..iterations.
        iterations: length of the run.
        levels: >= 0.
        until: when full resolution begins, as a fraction of the run in [0, 1].
    """
    end = until * iterations
    return 0 if iteration > end else math.ceil(levels * (1.0 - (iteration - 1) / end))


def evenly(iterations: int, count: int, first: float) -> list[int]:
    """`count` iterations, evenly spaced from the fraction `first` of the run to its last, which is one of them."""
    fractions = [first + (1.0 - first) * (k + 1) / count for k in range(count)]
    return [min(max(round(fraction * iterations), 1), iterations) for fraction in fractions]


def face_budgets(
    iterations: int, *, steps: int, first: float, last: float, start_faces: int, max_faces: int
) -> dict[int, int]:
    """When to subdivide, and to how many faces: evenly spaced, each time by the same factor.

    The k-th of n subdivisions may grow the mesh to start_faces (max_faces / start_faces)^(k / n) faces.

    Args:
        iterations: length of the run.
        steps: n, >= 0; no subdivision at 0.
        first: when the first one happens, as a fraction of the run in [0, 1].
        last: when the last one happens, as a fraction of the run in [first, 1].
        start_faces: faces before the first.
        max_faces: faces after the last, at most. No subdivision if there are as many already.

    Returns:
        Budget by iteration, ascending. Where several fall on one iteration it has the largest of their budgets.

    Example:
        >>> etsplat.face_budgets(1000, steps=2, first=0.1, last=0.6, start_faces=1000, max_faces=4000)
        {100: 2000, 600: 4000}
    """
    budgets = {}
    if max_faces > start_faces:
        for k in range(1, steps + 1):
            fraction = first + (last - first) * (k - 1) / max(steps - 1, 1)
            iteration = min(max(round(fraction * iterations), 1), iterations)
            budgets[iteration] = round(start_faces * (max_faces / start_faces) ** (k / steps))
    return budgets


def ramp(iteration: int, first: int, last: int) -> float:
    """Rises linearly from 0 at iteration `first` to 1 at `last`, and is constant before and after."""
    if iteration <= first:
        return 0.0
    return min(1.0, (iteration - first) / max(last - first, 1))
