"""Borders of masks before a plain surface: depths know little of it, but colours do.

What has no texture has no depth that photos agree on, so that masks by depths are wrong beside it by some pixels. There
alone, pixels at the border go by whether they have the colour of what is beside the mask, or of what is within.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt, gaussian_filter

PLAIN = 0.017
"""Standard deviation of the colours of what is beside a mask, up to which it is plain."""

_BAND, _ROUNDS = 0.05, 3
"""Of the root of the mask's area: how far from its border pixels may be wrong; and how often they are asked."""

_LIKE, _UNLIKE = 3.0, 4.0
"""In standard deviations: pixels are of what is beside the mask up to the first, and none of it from the second on."""

_OUT, _IN = 1.0, 2.0
"""In standard deviations of what is within: so far from it at least is what leaves the mask, at most what joins it."""

_LEAST = 0.01
"""A smaller deviation is taken for this."""

Colors = Float[np.ndarray, "H W 3"]


def at_plain_borders(mask: Bool[np.ndarray, "H W"], pixels: Colors) -> Bool[np.ndarray, "H W"]:
    """The mask, with its border mended by colours where what is beside it is plain.

    Args:
        mask: (H, W), with something and not all in it.
        pixels: (H, W, 3) the photo, in [0, 1].
    """
    band = max(2.0, _BAND * float(mask.sum()) ** 0.5)
    for _ in range(_ROUNDS):
        within, beside = np.asarray(distance_transform_edt(mask)), np.asarray(distance_transform_edt(~mask))
        inner, inner_spread, inner_weight = _local(pixels, within > band, band)
        outer, outer_spread, outer_weight = _local(pixels, beside > band, band)
        plain = (outer_spread < PLAIN) & (_apart(inner, outer, outer_spread) > _UNLIKE)
        asked = (within + beside <= band) & plain & (np.minimum(inner_weight, outer_weight) > 1e-3)
        from_inner, from_outer = _apart(pixels, inner, inner_spread), _apart(pixels, outer, outer_spread)
        leaves = asked & mask & (from_outer < _LIKE) & (from_inner > _OUT)
        joins = asked & ~mask & (from_outer > _UNLIKE) & (from_inner < _IN)
        mask = (mask & ~leaves) | joins
    return mask


def _local(
    pixels: Colors, chosen: Bool[np.ndarray, "H W"], reach: float
) -> tuple[Colors, Float[np.ndarray, "H W"], Float[np.ndarray, "H W"]]:
    """Mean and standard deviation of the chosen pixels around each one, and how much of its surroundings they are."""
    weight = gaussian_filter(chosen.astype(np.float64), reach)
    whole = weight[..., None] + 1e-9
    mean, square = (
        gaussian_filter(each * chosen[..., None], (reach, reach, 0)) / whole for each in (pixels, pixels**2)
    )
    return mean, np.sqrt((square - mean**2).clip(0).mean(axis=-1)), weight


def _apart(pixels: Colors, mean: Colors, spread: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """How far pixels are from a mean, in standard deviations."""
    return np.sqrt(((pixels - mean) ** 2).mean(axis=-1)) / np.maximum(spread, _LEAST)
