"""How far pictures are from depth maps."""

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.optim.depth_trust import DepthTrust
from etsplat.optim.objective import Drawing, Term
from etsplat.optim.schedules import Scheduled, at

_NEAR_ZERO = 1e-8
_CLIPPED = 3.0
"""Numbers of a map that are farther from their mean than so many standard deviations do not count for Pearson."""


class Depth(Term):
    """The distance of expected depths from those of the photo's map, where that knows them and something is drawn.

    Each pixel counts with its opacity, which gets no gradient. Of kind "l1" it is the mean of 2 |z - d| / (z + d): near
    the map the relative error, and 2 at most, so that no wrong number outweighs its neighbours. Of kind "pearson" it is
    1 minus the correlation of z, or of 1 / z, with the map's numbers, whatever their scale and shift.
    """

    name = "depth"
    outputs = ("depth",)

    def __init__(self, weight: Scheduled = 1.0, trust: DepthTrust | None = None) -> None:
        """Takes its weight, and which maps it believes in: by then, and as what. None for all, as depths."""
        self._trust = trust
        super().__init__(weight if trust is None else lambda iteration: at(weight, iteration) if trust.kind else 0.0)

    def __call__(self, drawing: Drawing) -> Float[Tensor, ""]:
        """Of one view; 0 without a map."""
        rendered, trust = drawing.rendering.depth, self._trust
        assert rendered is not None
        if drawing.depth is None:
            return rendered.new_zeros(())
        z, said = rendered[0, ..., 0], drawing.depth[0]
        counts = drawing.rendering.alpha.detach()[0, ..., 0] * ((said > 0) & (z.detach() > 0))
        if trust is not None:
            counts, said = counts * trust.believed(drawing.index), said * trust.unit
        if trust is None or trust.kind == "l1":
            apart = 2 * (z - said).abs() / (z + said).clamp_min(_NEAR_ZERO)
            return (counts * apart).sum() / counts.sum().clamp_min(1.0)
        return _uncorrelated(1 / z.clamp_min(_NEAR_ZERO) if trust.inverse else z, said, counts)


def _uncorrelated(
    values: Float[Tensor, "H W"], said: Float[Tensor, "H W"], counts: Float[Tensor, "H W"]
) -> Float[Tensor, ""]:
    """1 minus Pearson's correlation of what counts; 0 where nothing does."""

    def centred(numbers: Tensor, weights: Tensor) -> Tensor:
        return numbers - (weights * numbers).sum() / weights.sum().clamp_min(_NEAR_ZERO)

    def variance(numbers: Tensor, weights: Tensor) -> Tensor:
        return (weights * numbers.square()).sum() / weights.sum().clamp_min(_NEAR_ZERO)

    apart = centred(said, counts)
    counts = counts * (apart.square() <= _CLIPPED**2 * variance(apart, counts))
    x, y = centred(values, counts), centred(said, counts)
    both = (variance(x, counts) * variance(y, counts)).clamp_min(_NEAR_ZERO**2).sqrt()
    covariance = (counts * x * y).sum() / counts.sum().clamp_min(_NEAR_ZERO)
    return torch.where(counts.sum() > 0, 1 - covariance / both, 0.0)
