"""What operations of native code have in common: one autograd function around the two functions of an engine."""

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from etsplat.core.forward_mode import refuse_forward_mode
from etsplat.core.validation import check_native, dense


def differentiable(forward: Callable[..., Any], backward: Callable[..., Any]) -> Callable[..., Any]:
    """A method of engines from native code in both directions, which gets dense tensors and is outside of autograd.

    Args:
        forward: (keep, *arguments) -> (result, kept): a tensor or a tuple of them, and a tuple of whatever ``backward``
            needs, nothing if ``keep`` is False. It must not rely on addresses: autograd may hand over copies.
        backward: (kept, needed, *cotangents) -> gradients of the first arguments, the others have none. ``needed`` says
            of each argument whether its gradient is. A result of several that nothing was made of has cotangent None.
    """
    return partial(_Native.apply, forward, backward)


class _Native(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, forward: Callable[..., Any], backward: Callable[..., Any], *arguments: Any) -> Any:
        given = [_checked(argument) if isinstance(argument, Tensor) else argument for argument in arguments]
        result, kept = forward(any(ctx.needs_input_grad), *given)
        ctx.save_for_backward(*(item if isinstance(item, Tensor) else None for item in kept))
        ctx.constants = [None if isinstance(item, Tensor) else item for item in kept]
        ctx.gradients = backward
        ctx.set_materialize_grads(isinstance(result, Tensor))
        return result

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor | None) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        if torch.is_grad_enabled():  # these gradients are to have gradients, which would be zero without a word
            raise RuntimeError(
                "native engines have no gradients of gradients (create_graph=True); compute both within "
                'engine("reference"): with etsplat.engine("reference"): ...'
            )
        return _backward(ctx, *cotangents)

    jvp = staticmethod(refuse_forward_mode)


def _backward(ctx: Any, *cotangents: Tensor | None) -> tuple[Tensor | None, ...]:
    saved = zip(ctx.saved_tensors, ctx.constants, strict=True)
    kept = [constant if tensor is None else _dense(tensor) for tensor, constant in saved]
    needed = ctx.needs_input_grad[2:]
    gradients = ctx.gradients(kept, needed, *[None if given is None else _checked(given) for given in cotangents])
    return None, None, *gradients, *(None,) * (len(needed) - len(gradients))


def _checked(tensor: Tensor) -> Tensor:
    """As native code reads it, or ValueError."""
    check_native("gradient", tensor)
    return _dense(tensor)


def _dense(tensor: Tensor) -> Tensor:
    """Itself if it is: autograd copies the gradients that it is given where it must not add to them."""
    return tensor if tensor.is_contiguous() and not tensor.is_neg() else dense(tensor)
