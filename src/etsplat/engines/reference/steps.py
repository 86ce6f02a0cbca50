"""What a step of a fit updates in place, in plain PyTorch."""

from collections.abc import Sequence

import torch
from torch import Tensor

from etsplat.core.rasterization import TriangleStatistics

_VISIBLE_INRADIUS = 1.0

AdamGroup = tuple[Tensor, Tensor, Tensor, Tensor, Tensor | None]
"""A parameter, its gradient and both moments, contiguous; and factors of the rate for its rows."""


def step_rates(learning_rates: Sequence[float], betas: tuple[float, float], step_count: int) -> list[float]:
    """The step size of each parameter, lr / (1 - beta1^t), then sqrt(1 - beta2^t)."""
    first, second = (1 - beta**step_count for beta in betas)
    return [*(rate / first for rate in learning_rates), second**0.5]


def adam_step(
    groups: Sequence[AdamGroup],
    learning_rates: Sequence[float],
    decays: Sequence[float],
    betas: tuple[float, float],
    eps: float,
    step_count: int,
) -> None:
    """Update the parameters and their moments in place; see `etsplat.ops.adam`."""
    beta1, beta2 = betas
    for (parameter, gradient, first, second, paces), learning_rate, decay in zip(
        groups, learning_rates, decays, strict=True
    ):
        if decay != 0.0:
            gradient = gradient + decay * parameter
        first += (1 - beta1) * (gradient - first)
        second.mul_(beta2).add_((1 - beta2) * gradient * gradient)
        root = second.sqrt() / (1 - beta2**step_count) ** 0.5
        rate = learning_rate / (1 - beta1**step_count)
        if paces is not None:
            rate = rate * paces.reshape(-1, *[1] * (parameter.ndim - 1))
        parameter -= rate * (first / (root + eps))


def update_statistics(
    records: Sequence[Tensor], view: TriangleStatistics, views: int, epoch_starts: bool | Tensor
) -> None:
    """Update the records in place; see `etsplat.ops.soup_statistics`."""
    importance, screen_size, seen, trial = records
    seen_now = view.max_weight[0], view.screen_size[0], view.inradius[0]
    torch.maximum(importance, seen_now[0], out=importance)
    torch.maximum(screen_size, seen_now[1], out=screen_size)
    running = trial < views
    if not epoch_starts:
        running &= trial > 0
    seen += running & (seen_now[2] > _VISIBLE_INRADIUS)
    trial += running
