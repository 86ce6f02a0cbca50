"""L1 and structural dissimilarity in plain PyTorch."""

import torch
from jaxtyping import Float
from torch import Tensor

_C1, _C2 = 0.01**2, 0.03**2
_REACH, _SIGMA = 5, 1.5


def photometric_loss(
    color: Tensor,
    target: Tensor,
    mask: Tensor | None,
    backgrounds: Tensor | None,
    dssim_weight: float,
    squared: bool,
) -> Tensor:
    """See `etsplat.ops.photometric`."""
    y = target.to(color.dtype) / 255 if target.dtype == torch.uint8 else target
    if y.shape[-1] == 4:
        behind = 0 if backgrounds is None else (1 - y[..., 3:]) * backgrounds[:, None, None, :]
        y = y[..., :3] + behind
    x = color if mask is None else y + mask[..., None] * (color - y)
    difference = (x - y).square().mean() if squared else (x - y).abs().mean()
    if dssim_weight == 0:
        return difference
    return (1 - dssim_weight) * difference + dssim_weight * (1 - _similarity(x, y).mean())


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
