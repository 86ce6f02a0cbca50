"""Small numbers to the device, without waiting for it."""

from collections.abc import Sequence

import torch
from torch import Tensor


def upload(values: Sequence[float], device: torch.device) -> Tensor:
    """(N,) float32 on ``device``. The copy is queued like a kernel; torch keeps the pinned memory until it is done."""
    return torch.tensor(values, dtype=torch.float32, pin_memory=device.type == "cuda").to(device, non_blocking=True)
