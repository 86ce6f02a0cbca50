"""The CPU engine's side of `photometric_loss`: csrc/cpu/bind_photometric.cpp."""

from typing import Any

import torch
from torch import Tensor

from etsplat import _native
from etsplat.engines.native.operation import differentiable
from etsplat.engines.native.pool import empty_image


def _forward(
    keep: bool,
    color: Tensor,
    target: Tensor,
    mask: Tensor | None,
    backgrounds: Tensor | None,
    dssim_weight: float,
    squared: bool,
) -> tuple[Tensor, Any]:
    """One pass computes the value and the gradient, which waits for backward."""
    gradient = empty_image(*color.shape) if keep else None
    loss = _native.photometric(
        color=color,
        target=target,
        backgrounds=backgrounds,
        mask=mask,
        gradient=gradient,
        squared=squared,
        dssim_weight=dssim_weight,
    )
    return torch.tensor(loss), [gradient]


def _backward(kept: Any, _needed: Any, grad_loss: Tensor) -> tuple[Tensor]:
    (gradient,) = kept
    # Nearly always the loss is a plain term of the objective; then its gradient is ready as it is.
    return (gradient if float(grad_loss) == 1.0 else gradient * grad_loss,)


photometric_loss = differentiable(_forward, _backward)
