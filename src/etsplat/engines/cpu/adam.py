"""The CPU engine's side of `Adam`: csrc/cpu/bind_adam.cpp."""

from collections.abc import Sequence

from etsplat import _native
from etsplat.engines.reference.adam import AdamGroup


def adam_step(
    groups: Sequence[AdamGroup],
    learning_rates: Sequence[float],
    betas: tuple[float, float],
    eps: float,
    step_count: int,
) -> None:
    """See `Engine.adam_step`."""
    addresses = ([tensor.data_ptr() for tensor in tensors] for tensors in zip(*groups, strict=True))
    sizes = [group[0].numel() for group in groups]
    _native.adam_step(*addresses, sizes, list(learning_rates), *betas, eps, step_count)
