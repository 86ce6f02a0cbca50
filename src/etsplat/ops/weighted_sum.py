"""An objective from its terms, all of them numbers: first + scale sum_k weight_k value_k^power_k."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from etsplat.core.validation import check_like, check_shape
from etsplat.engines.choice import engine_for


@dataclass(frozen=True)
class Term:
    """weight value^power, with a scalar value."""

    weight: float
    value: Float[Tensor, ""]
    power: Literal[1, -1, -2] = 1


def weighted_sum(
    first: Float[Tensor, ""],
    terms: Sequence[Term],
    scale: float | Float[Tensor, ""] = 1.0,
) -> Float[Tensor, ""]:
    """The sum, differentiable with respect to ``first`` and the terms' values.

    Args:
        first: Scalar.
        terms: Any number of them.
        scale: Of the terms; a number, or a scalar tensor, which receives no gradient.

    Raises:
        ValueError: Wrong shape, dtype or device.
    """
    check_shape("first", first, ())
    for term in terms:
        check_shape("value", term.value, ())
        check_like("value", term.value, "first", first)
    if not terms:
        return first
    values, weights, powers = zip(*((term.value, term.weight, term.power) for term in terms), strict=True)
    return engine_for(first).weighted_sum(first, values, weights, powers, scale)
