"""Adam in plain PyTorch."""

from collections.abc import Sequence

from etsplat.engines.engine import AdamGroup


def adam_step(
    groups: Sequence[AdamGroup],
    learning_rates: Sequence[float],
    betas: tuple[float, float],
    eps: float,
    step_count: int,
) -> None:
    """See `Engine.adam_step`."""
    beta1, beta2 = betas
    for (parameter, gradient, first, second), learning_rate in zip(groups, learning_rates, strict=True):
        first += (1 - beta1) * (gradient - first)
        second.mul_(beta2).add_((1 - beta2) * gradient * gradient)
        root = second.sqrt() / (1 - beta2**step_count) ** 0.5
        parameter -= learning_rate / (1 - beta1**step_count) * (first / (root + eps))
