"""The colours that triangles start with, however they are given."""

from numbers import Real
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.validation import check_number, check_shape

_BRIGHTEST = 4.0
"""Fitted colours leave [0, 1] by a little; what is brighter than this has not been divided by 255."""


def start_colors(colors: Any, rows: str, count: int, like: Tensor) -> Float[Tensor, "N 3"]:
    """A colour for each triangle or vertex, in memory of its own.

    Args:
        colors: a tensor (N, 3); three numbers for all, as a tensor, tuple or list; or a number, a grey. In [0, 1].
        rows: the letter for N in messages.
        count: N.
        like: gives dtype and device.

    Raises:
        ValueError: it is nothing of that, of integers, or beyond [0, 1].
    """
    if isinstance(colors, Real) or (isinstance(colors, Tensor | np.ndarray) and colors.ndim == 0):
        check_number("colors", colors, 0, 1)
        return like.new_full((count, 3), float(colors))
    given: Any = colors
    if isinstance(colors, list | tuple) and len(colors) == 3 and all(isinstance(one, Real) for one in colors):
        given = torch.tensor([float(one) for one in colors], dtype=torch.float64)
    check_shape("colors", given, (rows, 3), (3,), sizes={rows: count})
    if not given.is_floating_point():
        raise ValueError(f"colors must be floats in [0, 1], got {given.dtype}: divide bytes by 255")
    if given.numel():
        low, high = (float(value) for value in torch.aminmax(given.detach()))
        if not (low >= -_BRIGHTEST and high <= _BRIGHTEST):  # NaN is neither
            raise ValueError(f"colors must be in [0, 1], got {low:.4g} to {high:.4g}")
    return given.detach().to(like).expand(count, 3).clone()
