"""How well depth maps agree with another knowledge of the same depths: points, or a picture of the model.

What a map explains of depths z is 1 - median |z - d| / median |z - median z|: 1 where it has them all, 0 or less where
a plane would do as well. Medians, so that neither a few pixels that are wildly wrong nor points that are hidden count.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

DepthKind = Literal["l1", "pearson"]

FEWEST = 30
"""Pixels of a map with a known depth from elsewhere, below which nothing is said of it."""

_ROUNDS, _USUAL = 5, 4.0
"""Lines are fitted so often, first to the numbers of a map that are within so many median distances of their median,
then each time to the half of all that was nearest to the one before."""

Pairs = tuple[Float[Tensor, " K"], Float[Tensor, " K"]]
"""Depths known from elsewhere, and those of a map at the same pixels; all positive."""


@dataclass(frozen=True)
class DepthAgreement:
    """Of the maps of several views.

    Attributes:
        factor: the median of known depth over that of the maps; NaN where nothing can be said.
        l1: what each map explains as it is, NaN of views with too few pixels.
        pearson: the same, each map with the scale and shift that suit it best.
        inverse: whether the maps are of inverse depths (disparities), of which pearson is then.
    """

    factor: float
    l1: Float[Tensor, " V"]
    pearson: Float[Tensor, " V"]
    inverse: bool

    def of(self, kind: DepthKind) -> Float[Tensor, " V"]:
        """By view."""
        return self.l1 if kind == "l1" else self.pearson

    def overall(self, kind: DepthKind) -> float:
        """The median over the views; -infinity where nothing can be said."""
        found = self.of(kind)
        found = found[~found.isnan()]
        return float(found.median()) if len(found) else -math.inf


def depth_agreement(views: Sequence[Pairs]) -> DepthAgreement:
    """How maps agree with depths known from elsewhere.

    Args:
        views: of each map, the depths and its own at some pixels.
    """
    said = [(z.double(), d.double()) for z, d in views if len(z) >= FEWEST]
    ratios = torch.cat([(z / d).log() for z, d in said]) if said else torch.full((1,), math.nan)
    fits = {inverse: torch.tensor([_fitted(z, d, inverse) for z, d in views]) for inverse in (False, True)}
    inverse = bool(fits[True].nanmedian() > fits[False].nanmedian())
    return DepthAgreement(float(ratios.median().exp()), explained_as_they_are(views), fits[inverse], inverse)


def explained_as_they_are(views: Sequence[Pairs]) -> Float[Tensor, " V"]:
    """What each map explains, without scale or shift; NaN of views with too few pixels."""
    return torch.tensor([_explained(z.double(), z.double() - d.double()) for z, d in views])


def _explained(known: Float[Tensor, " K"], errors: Float[Tensor, " K"]) -> float:
    """NaN of too few, or of depths that do not differ."""
    if len(known) < FEWEST:
        return math.nan
    spread = float((known - known.median()).abs().median())
    return 1 - float(errors.abs().median()) / spread if spread > 0 else math.nan


def _fitted(depth: Float[Tensor, " K"], said: Float[Tensor, " K"], inverse: bool) -> float:
    """Of the line through a map's numbers, rising, that fits the depths or their inverses: least trimmed squares."""
    known, numbers = (1 / depth.double() if inverse else depth.double()), said.double()
    if len(known) < FEWEST:
        return math.nan
    away = (numbers - numbers.median()).abs()
    near = away <= _USUAL * away.median()
    slope = offset = torch.zeros((), dtype=torch.float64)
    for _ in range(_ROUNDS):
        x, y = numbers[near], known[near]
        spread = (x - x.mean()).square().sum()
        slope = ((x - x.mean()) * (y - y.mean())).sum() / spread if spread > 0 else torch.zeros_like(spread)
        offset = y.mean() - slope * x.mean()
        errors = (known - slope * numbers - offset).abs()
        near = errors <= errors.median()
    return _explained(known, known - slope.clamp_min(0) * numbers - offset)
