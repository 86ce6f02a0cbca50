"""A value of each triangle at the pixels that show it, in plain PyTorch."""

import torch
from torch import Tensor


def pick_values(values: Tensor, chosen: Tensor) -> Tensor:
    """See `etsplat.ops.pick_values`."""
    behind = torch.cat([values.new_zeros(len(values), 1), values], dim=1)
    return behind.gather(1, chosen.long().flatten(start_dim=1)).view(chosen.shape)
