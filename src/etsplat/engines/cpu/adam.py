"""The CPU engine's side of `Adam`: csrc/cpu/bind_adam.cpp."""

from collections.abc import Sequence

from etsplat import _native
from etsplat.engines.reference.steps import AdamGroup


def adam_step(
    groups: Sequence[AdamGroup],
    learning_rates: Sequence[float],
    decays: Sequence[float],
    betas: tuple[float, float],
    eps: float,
    step_count: int,
) -> None:
    """See `Engine.adam_step`."""
    parameters, gradients, firsts, seconds, paces = zip(*groups, strict=True)
    _native.adam_step(
        parameters=parameters,
        gradients=gradients,
        firsts=firsts,
        seconds=seconds,
        paces=paces,
        learning_rates=learning_rates,
        decays=decays,
        beta1=betas[0],
        beta2=betas[1],
        eps=eps,
        step=step_count,
    )
