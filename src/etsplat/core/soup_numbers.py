"""How a soup is drawn, as far as it may change from step to step."""

import math
from typing import NamedTuple

DRAWS = 2**24
"""How many different draws there are: each is a whole number that float32 holds."""


class SoupNumbers(NamedTuple):
    """What every triangle's opacity and softness go through (ops/soup_activation.py).

    Attributes:
        opacity_floor: in [0, 1); opacities are squeezed into [floor, 1].
        sigma_ceiling: softness is cut here; may be infinite.
        dropout: in [0, 1); so large a share of the triangles is left out by chance.
        draw: a whole number from 0 to `DRAWS` - 1. Each leaves out others, the same ones on every engine.
    """

    opacity_floor: float = 0.0
    sigma_ceiling: float = math.inf
    dropout: float = 0.0
    draw: float = 0.0
