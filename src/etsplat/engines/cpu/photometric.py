"""The CPU engine's side of `photometric_loss`: csrc/cpu/bind_photometric.cpp."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from etsplat import _native
from etsplat.core.validation import dense
from etsplat.engines.native.pool import empty_image


def photometric_loss(
    color: Tensor,
    target: Tensor,
    mask: Tensor | None,
    backgrounds: Tensor | None,
    dssim_weight: float,
    squared: bool,
) -> Tensor:
    """See `Engine.photometric_loss`."""
    loss: Any = _PhotometricLoss.apply(color, target, mask, backgrounds, dssim_weight, squared)
    return loss


class _PhotometricLoss(torch.autograd.Function):
    """One pass computes the value and the gradient, which waits for backward."""

    @staticmethod
    def forward(
        ctx: Any,
        color: Tensor,
        target: Tensor,
        mask: Tensor | None,
        backgrounds: Tensor | None,
        dssim_weight: float,
        squared: bool,
    ) -> Tensor:
        gradient = empty_image(*color.shape) if ctx.needs_input_grad[0] else None
        loss = _native.photometric(
            color=dense(color),
            target=dense(target),
            backgrounds=None if backgrounds is None else dense(backgrounds),
            mask=None if mask is None else dense(mask),
            gradient=gradient,
            squared=squared,
            dssim_weight=dssim_weight,
        )
        if gradient is not None:
            ctx.save_for_backward(gradient)
        return torch.tensor(loss)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_loss: Tensor) -> tuple[Tensor, None, None, None, None, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        (gradient,) = ctx.saved_tensors
        # Nearly always the loss is a plain term of the objective; then its gradient is ready as it is.
        return gradient if float(grad_loss) == 1.0 else gradient * grad_loss, None, None, None, None, None
