"""The photometric loss of shape reconstruction: L1 against a picture composited over the step's background.

    L_c = mean |color - (rgb + (1 - a) background)|

over views, pixels and channels (paper, section 3.3), with the target's premultiplied colour rgb and its coverage a.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat import _native
from etsplat.core.validation import check_like, check_shape
from etsplat.ops._photometric_cuda import L1OverBackgroundCuda
from etsplat.ops.engines import resolve_engine


def l1_over_background(
    color: Float[Tensor, "B H W 3"],
    target: Float[Tensor, "B H W 4"],
    backgrounds: Float[Tensor, "B 3"],
    *,
    engine: str | None = None,
) -> Float[Tensor, ""]:
    """Mean absolute difference of ``color`` and ``target`` over ``backgrounds``.

    Args:
        color: (B, H, W, 3) rendered over the same backgrounds; the only argument that receives a gradient, which is 0
            where the difference is.
        target: (B, H, W, 4) premultiplied RGBA in [0, 1].
        backgrounds: (B, 3), one colour per view.
        engine: "cpu", "cuda", "reference" or None (by dtype and device).

    Returns:
        The mean, a scalar. The native engines add in a fixed order: the same bits in every run.

    Raises:
        ValueError: Wrong shape, dtype or device; an empty image; a target or background that wants a gradient.
    """
    check_shape("color", color, ("B", "H", "W", 3))
    check_shape("target", target, (*color.shape[:3], 4))
    check_shape("backgrounds", backgrounds, (color.shape[0], 3))
    for name, constant in (("target", target), ("backgrounds", backgrounds)):
        check_like(name, constant, "color", color)
        if constant.requires_grad:
            raise ValueError(f"{name} receives no gradient from this loss: pass {name}.detach()")
    if color.numel() == 0:
        raise ValueError(f"color must hold at least one pixel, got shape {tuple(color.shape)}")
    chosen = resolve_engine(engine, color)
    if chosen != "reference":
        native = L1OverBackgroundCuda if chosen == "cuda" else _L1OverBackground
        loss: Any = native.apply(color, target, backgrounds)
        return loss
    composited = target[..., :3] + (1 - target[..., 3:]) * backgrounds[:, None, None, :]
    return (color - composited).abs().mean()


class _L1OverBackground(torch.autograd.Function):
    """One pass computes the value and the gradient, which waits for backward."""

    @staticmethod
    def forward(ctx: Any, color: Tensor, target: Tensor, backgrounds: Tensor) -> Tensor:
        color, target, backgrounds = color.contiguous(), target.contiguous(), backgrounds.contiguous()
        gradient = torch.empty_like(color) if ctx.needs_input_grad[0] else None
        mean = _native.l1_over_background(
            color.data_ptr(),
            target.data_ptr(),
            backgrounds.data_ptr(),
            len(color),
            color.shape[1] * color.shape[2],
            0 if gradient is None else gradient.data_ptr(),
        )
        if gradient is not None:
            ctx.save_for_backward(gradient)
        return color.new_tensor(mean)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad_loss: Tensor) -> tuple[Tensor, None, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        (gradient,) = ctx.saved_tensors
        # Nearly always the loss is a plain term of the objective; then its gradient is ready as it is.
        return gradient if float(grad_loss) == 1.0 else gradient * grad_loss, None, None
