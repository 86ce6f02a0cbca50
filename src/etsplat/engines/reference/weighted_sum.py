"""An objective from its terms, in plain PyTorch."""

from collections.abc import Sequence

from torch import Tensor


def weighted_sum(
    first: Tensor,
    values: Sequence[Tensor],
    weights: Sequence[float],
    powers: Sequence[int],
    scale: float | Tensor,
) -> Tensor:
    """See `etsplat.ops.weighted_sum`; at least one value."""
    powered = (value if power == 1 else value.pow(power) for value, power in zip(values, powers, strict=True))
    total, *others = (weight * value for weight, value in zip(weights, powered, strict=True))
    for other in others:
        total = total + other
    return first + scale * total
