"""A value of each triangle, such as its depth, at the pixels that show it."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from etsplat.core.validation import check_device, check_indices, check_shape
from etsplat.engines.choice import engine_for


def pick_values(values: Float[Tensor, "B N"], chosen: Int[Tensor, "B H W"]) -> Float[Tensor, "B H W"]:
    """``values[b, chosen[b, i, j] - 1]``, 0 where ``chosen`` is 0; differentiable with respect to ``values``.

    How many pixels are 0 is not asked, which on a GPU would mean to wait for it.

    Args:
        values: (B, N).
        chosen: (B, H, W) int32 from 0 to N.

    Returns:
        (B, H, W). Gradients are added in a fixed order, or as integers: the same bits in every run.

    Raises:
        ValueError: Wrong shape, dtype or device, or on the CPU an index out of range; the message names the argument.
    """
    check_shape("values", values, ("B", "N"))
    check_shape("chosen", chosen, (len(values), "H", "W"))
    check_device("chosen", chosen, "values", values)
    if chosen.dtype != torch.int32:
        raise ValueError(f"chosen must be int32, got {chosen.dtype}")
    if chosen.is_cpu:  # reading it would wait for a GPU, which takes what is out of range for 0
        check_indices("chosen", chosen, values.shape[1] + 1)
    return engine_for(values).pick_values(values, chosen)
