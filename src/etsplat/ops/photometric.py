"""The photometric loss: L1 and structural dissimilarity (3D Gaussian splatting's L_rgb; with l = 0 the paper's L_c).

    L = (1 - l) mean |x - y| + l (1 - SSIM(x, y))

over views, pixels and channels. SSIM (Wang et al. 2004) has an 11 x 11 Gaussian window of sigma 1.5, C1 = 0.01^2,
C2 = 0.03^2 and zeros beyond the border. y is the target over the background, and x the rendering where the mask is 1,
the target where it is 0: pixels that are masked out count as right.
"""

from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from etsplat import _native
from etsplat.core.validation import check_choice, check_device, check_like, check_shape, dense
from etsplat.ops._photometric_cuda import PhotometricLossCuda
from etsplat.ops.engines import resolve_engine
from etsplat.ops.pool import empty_image

_C1, _C2 = 0.01**2, 0.03**2
_REACH, _SIGMA = 5, 1.5


def photometric_loss(
    color: Float[Tensor, "B H W 3"],
    target: Float[Tensor, "B H W C"] | UInt8[Tensor, "B H W C"],
    dssim_weight: float,
    mask: Float[Tensor, "B H W"] | None = None,
    *,
    backgrounds: Float[Tensor, "B 3"] | None = None,
    pixel: Literal["l1", "l2"] = "l1",
    engine: str | None = None,
) -> Float[Tensor, ""]:
    """Mean difference of ``color`` and ``target``, in value and in structure.

    Args:
        color: (B, H, W, 3) rendered over the same backgrounds; the only argument that receives a gradient.
        target: (B, H, W, 3), or (B, H, W, 4) premultiplied RGBA; bytes, or floating point in [0, 1].
        dssim_weight: l, from 0 to 1. At 0 no SSIM is computed.
        mask: (B, H, W) in [0, 1]: how much each pixel counts. None for all.
        backgrounds: (B, 3), one colour per view, behind a target with alpha; None for black.
        pixel: "l1" for the mean absolute difference, "l2" for the mean square.
        engine: "cpu", "cuda", "reference" or None (by dtype and device).

    Returns:
        A scalar. The native engines add in a fixed order: the same bits in every run.

    Raises:
        ValueError: Wrong shape, dtype, device or range; an empty image; a constant that wants a gradient.
    """
    _check(color, target, mask, backgrounds)
    check_choice("pixel", pixel, ("l1", "l2"))
    if not 0.0 <= dssim_weight <= 1.0:
        raise ValueError(f"dssim_weight must be from 0 to 1, got {dssim_weight}")
    chosen = resolve_engine(engine, color)
    if chosen == "cuda":
        on_device: Any = PhotometricLossCuda.apply(color, target, mask, backgrounds, dssim_weight, pixel == "l2")
        return on_device
    if chosen == "cpu":
        settings = _Settings(dssim_weight, pixel == "l2")
        loss: Any = _PhotometricLoss.apply(color, target, mask, backgrounds, settings)
        return loss
    y = target.to(color.dtype) / 255 if target.dtype == torch.uint8 else target
    if y.shape[-1] == 4:
        behind = 0 if backgrounds is None else (1 - y[..., 3:]) * backgrounds[:, None, None, :]
        y = y[..., :3] + behind
    x = color if mask is None else y + mask[..., None] * (color - y)
    difference = (x - y).square().mean() if pixel == "l2" else (x - y).abs().mean()
    if dssim_weight == 0:
        return difference
    return (1 - dssim_weight) * difference + dssim_weight * (1 - _similarity(x, y).mean())


def _check(color: Tensor, target: Tensor, mask: Tensor | None, backgrounds: Tensor | None) -> None:
    check_shape("color", color, ("B", "H", "W", 3))
    check_shape("target", target, (*color.shape[:3], 3), (*color.shape[:3], 4))
    if color.numel() == 0:
        raise ValueError(f"color must hold at least one pixel, got shape {tuple(color.shape)}")
    if target.dtype == torch.uint8:
        check_device("target", target, "color", color)
    else:
        check_like("target", target, "color", color)
    constants = {"target": target}
    if mask is not None:
        check_shape("mask", mask, tuple(color.shape[:3]))
        check_like("mask", mask, "color", color)
        constants["mask"] = mask
    if backgrounds is not None:
        check_shape("backgrounds", backgrounds, (color.shape[0], 3))
        check_like("backgrounds", backgrounds, "color", color)
        constants["backgrounds"] = backgrounds
    for name, constant in constants.items():
        if constant.requires_grad:
            raise ValueError(f"{name} receives no gradient from this loss: pass {name}.detach()")


@dataclass(frozen=True)
class _Settings:
    dssim_weight: float
    squared: bool


class _PhotometricLoss(torch.autograd.Function):
    """One pass computes the value and the gradient, which waits for backward."""

    @staticmethod
    def forward(
        ctx: Any, color: Tensor, target: Tensor, mask: Tensor | None, backgrounds: Tensor | None, settings: _Settings
    ) -> Tensor:
        images = [None if tensor is None else dense(tensor) for tensor in (color, target, backgrounds, mask)]
        gradient = empty_image(*color.shape) if ctx.needs_input_grad[0] else None
        loss = _native.photometric(
            *(0 if tensor is None else tensor.data_ptr() for tensor in (*images, gradient)),
            *color.shape[:3],
            target.shape[-1],
            target.dtype == torch.uint8,
            settings.squared,
            settings.dssim_weight,
        )
        if gradient is not None:
            ctx.save_for_backward(gradient)
        return torch.tensor(loss)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad_loss: Tensor) -> tuple[Tensor, None, None, None, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        (gradient,) = ctx.saved_tensors
        # Nearly always the loss is a plain term of the objective; then its gradient is ready as it is.
        return gradient if float(grad_loss) == 1.0 else gradient * grad_loss, None, None, None, None


def _similarity(x: Float[Tensor, "B H W 3"], y: Float[Tensor, "B H W 3"]) -> Float[Tensor, "B H W 3"]:
    """SSIM at every pixel and channel."""
    mean_x, mean_y, square_x, square_y, product = (_blur(image) for image in (x, y, x * x, y * y, x * y))
    variances = square_x - mean_x**2 + square_y - mean_y**2
    covariance = product - mean_x * mean_y
    return ((2 * mean_x * mean_y + _C1) * (2 * covariance + _C2)) / ((mean_x**2 + mean_y**2 + _C1) * (variances + _C2))


def _blur(image: Float[Tensor, "B H W 3"]) -> Float[Tensor, "B H W 3"]:
    """The separable Gaussian window; beyond the border there are zeros."""
    offsets = torch.arange(-_REACH, _REACH + 1, dtype=image.dtype, device=image.device)
    window = torch.exp(-(offsets**2) / (2 * _SIGMA**2))
    window = window / window.sum()
    flat = image.movedim(-1, 1).reshape(-1, 1, *image.shape[1:3])
    flat = torch.nn.functional.conv2d(flat, window.view(1, 1, -1, 1), padding=(_REACH, 0))
    flat = torch.nn.functional.conv2d(flat, window.view(1, 1, 1, -1), padding=(0, _REACH))
    return flat.reshape(len(image), 3, *image.shape[1:3]).movedim(1, -1)
