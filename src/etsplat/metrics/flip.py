"""FLIP: how visibly two pictures differ to who flips between them (Andersson et al. 2020, LDR-FLIP); no weights.

A colour difference, after what the eye cannot resolve is blurred away, raised to the power of one minus a difference
of edges and points. Equation and table numbers are those of the paper.
"""

import math
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor, nn

from etsplat.core.precision import as_given
from etsplat.core.validation import check_device, check_floating, check_memory
from etsplat.engines.threads import all_torch_threads, one_torch_thread

PIXELS_PER_DEGREE = 67.0
"""Of a display 0.7 m away that is 3840 pixels and 0.7 m wide: the paper's default."""

_WHITE = (0.31271, 0.32902)
"""Chromaticity of illuminant D65, 2 degree observer."""

_PRIMARIES = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06))
"""Chromaticities of sRGB's red, green and blue (IEC 61966-2-1)."""

_SENSITIVITY = (((1.0, 0.0047),), ((1.0, 0.0053),), ((34.1, 0.04), (13.5, 0.025)))
"""Of the channels Y, Cx, Cz: amplitudes a and widths b of the Gaussians of table 1, in degrees."""

_WIDEST = 0.04
"""The largest of these widths: all filters have its support."""

_COLOR_POWER, _COLOR_SHARE, _COLOR_RANGE = 0.7, 0.4, 0.95
"""q_c, p_c, p_t: differences up to p_c of the largest take p_t of the range."""

_BEYOND = 0.5
"""Values of the truth may be as far outside of [0, 1], as resampling leaves them."""

_FEATURE_WIDTH, _FEATURE_POWER = 0.082, 0.5
"""Width of what counts as an edge or a point, in degrees, and q_f."""


@one_torch_thread()
@as_given
def flip(
    image: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"], *, pixels_per_degree: float = PIXELS_PER_DEGREE
) -> Float[Tensor, ""]:
    """LDR-FLIP, the mean over pixels: 0 for equal pictures, 1 for the largest difference that there is.

    Differentiable with respect to both; where a difference is 0 its gradient is 0. Beyond the border the pictures go on
    with the pixels at it. The result depends on how large a pixel looks: values of other distances do not compare.

    Args:
        image: as displayed (sRGB), values in [0, 1].
        truth: likewise.
        pixels_per_degree: of visual angle; above 0.

    Raises:
        ValueError: shapes differ or are not (H, W, 3), there are no pixels, or no floating-point numbers; `truth` has
            values beyond [0, 1]; `pixels_per_degree` is not positive.

    Example:
        >>> black, white = torch.zeros(8, 8, 3), torch.ones(8, 8, 3)
        >>> float(etsplat.flip(black, black)), float(etsplat.flip(black, white)) > 0.9
        (0.0, True)
    """
    check_memory("image", image)
    check_memory("truth", truth)
    check_device("truth", truth, "image", image)
    if image.ndim != 3 or image.shape[-1] != 3:
        raise ValueError(f"image: expected shape (H, W, 3), got {tuple(image.shape)}")
    if image.shape != truth.shape:
        raise ValueError(f"truth: expected the image's shape {tuple(image.shape)}, got {tuple(truth.shape)}")
    check_floating("image", image)
    check_floating("truth", truth)
    if image.numel() == 0:
        raise ValueError(f"image: expected a pixel or more, got shape {tuple(image.shape)}")
    if not 0 < pixels_per_degree < math.inf:
        raise ValueError(f"pixels_per_degree: expected a positive number, got {pixels_per_degree}")
    if float((truth.detach() - 0.5).abs().max()) > 0.5 + _BEYOND:  # not of those that are NaN
        raise ValueError("truth: expected values in [0, 1], got others; divide by 255 what is from 0 to 255")
    image = image.float() if image.dtype in (torch.float16, torch.bfloat16) else image
    pair = torch.stack([image, truth.to(image)]).movedim(-1, 1)
    opponent = _opponent(_xyz(pair))
    color = _redistributed(_hyab(*_perceived(opponent, pixels_per_degree)))
    feature = _feature_difference(opponent[:, 0] / 116 + 16 / 116, pixels_per_degree)
    return _power(color, 1 - feature).mean() + 0 * pair.sum()  # NaN where a value is not finite, which clamping hides


def _xyz(srgb: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B 3 H W"]:
    """Relative to the white: (1, 1, 1) is white."""
    curved = ((srgb.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4
    linear = torch.where(srgb > 0.04045, curved, srgb / 12.92)
    return torch.einsum("ij,bjhw->bihw", _from_linear().to(srgb), linear)


def _opponent(xyz: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B 3 H W"]:
    """YCxCz, a linear L*a*b*: what the contrast sensitivity was measured in."""
    x, y, z = xyz.unbind(1)
    return torch.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], dim=1)


def _perceived(opponent: Float[Tensor, "B 3 H W"], pixels_per_degree: float) -> Float[Tensor, "B 3 H W"]:
    """What the eye resolves of them (section 4.1.1), in L*a*b* whose colours fade with the light (4.1.2, Hunt)."""
    radius = math.ceil(3 * math.sqrt(_WIDEST / (2 * math.pi**2)) * pixels_per_degree)
    filtered = []
    for channel, gaussians in zip(opponent.unbind(1), _SENSITIVITY, strict=True):
        planes, total = [], 0.0
        for a, b in gaussians:
            bell = _offsets(radius, opponent).div(pixels_per_degree).square().mul(-(math.pi**2) / b).exp()
            weight = a * math.sqrt(math.pi / b) * float(bell.sum()) ** 2
            planes.append(weight * _separable(channel, bell / bell.sum(), bell / bell.sum()))
            total += weight
        filtered.append(torch.stack(planes).sum(dim=0) / total)
    y, cx, cz = filtered
    y = (y + 16) / 116
    linear = torch.einsum(
        "ij,bjhw->bihw", _from_linear().inverse().to(y), torch.stack([cx / 500 + y, y, y - cz / 200], dim=1)
    )
    return _hunt_lab(torch.einsum("ij,bjhw->bihw", _from_linear().to(y), linear.clamp(0, 1)))


def _hunt_lab(xyz: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B 3 H W"]:
    """L*, and a* and b* times L* / 100."""
    delta = 6 / 29
    root = torch.where(xyz > delta**3, xyz.clamp_min(delta**3) ** (1 / 3), xyz / (3 * delta**2) + 4 / 29)
    x, y, z = root.unbind(1)
    light = 116 * y - 16
    return torch.stack([light, 5 * light * (x - y), 2 * light * (y - z)], dim=1)


def _hyab(image: Float[Tensor, "3 H W"], truth: Float[Tensor, "3 H W"]) -> Float[Tensor, "H W"]:
    """Equation 3: city block between lightness and colour, Euclidean within colour."""
    light, a, b = (image - truth).unbind(0)
    return light.abs() + _norm(a, b)


def _redistributed(difference: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Equation 4: small differences take most of [0, 1], up to that of the farthest colours, green and blue."""
    green_blue = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)[..., None, None]
    largest = float(_hyab(*_hunt_lab(_xyz(green_blue)))) ** _COLOR_POWER
    knee, error = _COLOR_SHARE * largest, _power(difference, torch.tensor(_COLOR_POWER).to(difference))
    small = _COLOR_RANGE / knee * error
    large = _COLOR_RANGE + (1 - _COLOR_RANGE) * (error - knee) / (largest - knee)
    return torch.where(error < knee, small, large)


def _feature_difference(light: Float[Tensor, "B H W"], pixels_per_degree: float) -> Float[Tensor, "H W"]:
    """Equation 5: how unlike edges and points are, by first and second derivatives of a Gaussian (section 4.2)."""
    sigma = 0.5 * _FEATURE_WIDTH * pixels_per_degree
    offsets = _offsets(math.ceil(3 * sigma), light)
    bell = torch.exp(-(offsets**2) / (2 * sigma**2))
    found = []
    for derivative in (-offsets * bell, (offsets**2 / sigma**2 - 1) * bell):
        rise, fall = derivative.clamp_min(0).sum(), -derivative.clamp_max(0).sum()
        unit = torch.where(derivative > 0, derivative / rise, derivative / fall)
        across, down = _separable(light, unit, bell / bell.sum()), _separable(light, bell / bell.sum(), unit)
        strength = _norm(across, down)
        found.append((strength[0] - strength[1]).abs())
    most = torch.maximum(*found) / math.sqrt(2)
    return _power(most, torch.tensor(_FEATURE_POWER).to(most))


def _separable(
    planes: Float[Tensor, "B H W"], across: Float[Tensor, " K"], down: Float[Tensor, " K"]
) -> Float[Tensor, "B H W"]:
    """Filtered along rows and columns; beyond the border there is the pixel at it."""
    radius = len(across) // 2
    with all_torch_threads():
        wide = nn.functional.pad(planes[:, None], (radius,) * 4, mode="replicate")
        wide = nn.functional.conv2d(wide, across.view(1, 1, 1, -1))
        return nn.functional.conv2d(wide, down.view(1, 1, -1, 1))[:, 0]


def _offsets(radius: int, like: Tensor) -> Float[Tensor, " K"]:
    return torch.arange(-radius, radius + 1, dtype=like.dtype, device=like.device)


def _norm(x: Tensor, y: Tensor) -> Tensor:
    """The length, with gradient 0 at 0."""
    return _power(x**2 + y**2, x.new_tensor(0.5))


def _power(base: Tensor, exponent: Tensor) -> Tensor:
    """Of what is not negative, with gradient 0 at 0, where it is infinite or none."""
    positive = base > 0
    return torch.where(positive, torch.where(positive, base, 1.0) ** exponent, 0.0)


@cache
def _from_linear() -> Float[Tensor, "3 3"]:
    """Linear sRGB to XYZ relative to the white, in float64: primaries weighted so that together they are white."""
    columns = torch.tensor([[x / y, 1.0, (1 - x - y) / y] for x, y in _PRIMARIES], dtype=torch.float64).T
    x, y = _WHITE
    white = torch.tensor([x / y, 1.0, (1 - x - y) / y], dtype=torch.float64)
    return columns * torch.linalg.solve(columns, white) / white[:, None]
