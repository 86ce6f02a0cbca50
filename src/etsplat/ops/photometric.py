"""The photometric loss: L1 and structural dissimilarity (3D Gaussian splatting's L_rgb; with l = 0 the paper's L_c).

    L = (1 - l) mean |x - y| + l (1 - SSIM(x, y))

over views, pixels and channels. SSIM (Wang et al. 2004) has an 11 x 11 Gaussian window of sigma 1.5, C1 = 0.01^2,
C2 = 0.03^2 and zeros beyond the border. y is the target over the background, and x the rendering where the mask is 1,
the target where it is 0: pixels that are masked out count as right.
"""

from typing import Literal

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from etsplat.core.backgrounds import for_each_view
from etsplat.core.precision import as_given
from etsplat.core.validation import check_choice, check_device, check_like, check_number, check_shape
from etsplat.engines.choice import engine_for


@as_given
def photometric_loss(
    color: Float[Tensor, "B H W 3"],
    target: Float[Tensor, "B H W C"] | UInt8[Tensor, "B H W C"],
    dssim_weight: float,
    mask: Float[Tensor, "B H W"] | None = None,
    *,
    backgrounds: Float[Tensor, "3"] | Float[Tensor, "B 3"] | None = None,
    pixel: Literal["l1", "l2"] = "l1",
) -> Float[Tensor, ""]:
    """Mean difference of ``color`` and ``target``, in value and in structure.

    Args:
        color: (B, H, W, 3) rendered over the same backgrounds; the only argument that receives a gradient.
        target: (B, H, W, 3), or (B, H, W, 4) premultiplied RGBA; bytes, or floating point in [0, 1].
        dssim_weight: l, from 0 to 1. At 0 no SSIM is computed.
        mask: (B, H, W) in [0, 1]: how much each pixel counts. None for all.
        backgrounds: (3,), or (B, 3) of each view, behind a target with alpha; None for black.
        pixel: "l1" for the mean absolute difference, "l2" for the mean square.

    Returns:
        A scalar. The native engines add in a fixed order: the same bits in every run.

    Raises:
        ValueError: Wrong shape, dtype, device or range; an empty image; a constant that wants a gradient.

    Example:
        >>> photo = torch.full((1, 16, 16, 3), 0.5)
        >>> etsplat.photometric_loss(photo, photo + 0.25, dssim_weight=0.0)
        tensor(0.2500)
    """
    check_shape("color", color, ("B", "H", "W", 3))
    backgrounds = for_each_view(backgrounds, len(color))
    _check(color, target, mask, backgrounds)
    check_choice("pixel", pixel, ("l1", "l2"))
    check_number("dssim_weight", dssim_weight, 0, 1)
    return engine_for(color).photometric_loss(color, target, mask, backgrounds, dssim_weight, pixel == "l2")


def _check(color: Tensor, target: Tensor, mask: Tensor | None, backgrounds: Tensor | None) -> None:
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
        check_shape("backgrounds", backgrounds, (3,), (color.shape[0], 3))
        check_like("backgrounds", backgrounds, "color", color)
        constants["backgrounds"] = backgrounds
    for name, constant in constants.items():
        if constant.requires_grad:
            raise ValueError(f"{name} receives no gradient from this loss: pass {name}.detach()")
