"""How close an engine must come to the float64 oracle.

Float32 gradients are sums of terms that cancel: the last layers of a pixel are off by 1e-3 of themselves, but by a few
1e-6 of the largest term. Errors are therefore measured against the largest magnitude of the whole expected tensor.
Where float32 and float64 decide differently (alpha against 1/255, x against 2, two almost equal depths, the nearest
edge of a pixel), a few elements are off by more; how many and by how much is bounded too.
"""

import math

import torch
from torch import Tensor


def error_to_scale(actual: Tensor, expected: Tensor, scale: float | None = None) -> Tensor:
    """|actual - expected| over ``scale``, by default the largest |expected|; infinite where actual is not finite."""
    assert actual.shape == expected.shape, f"shape {tuple(actual.shape)} is not {tuple(expected.shape)}"
    assert expected.isfinite().all(), "the expected tensor itself is not finite"
    actual, expected = actual.detach().double().cpu(), expected.detach().double()
    if expected.numel() == 0:
        return expected
    unit = expected.abs().max() if scale is None else expected.new_tensor(scale)
    difference = (actual - expected).abs()
    error = torch.where(difference == 0, 0.0, difference / unit)
    return torch.where(actual.isfinite(), error, torch.inf)


def assert_close_to_scale(
    actual: Tensor,
    expected: Tensor,
    tolerance: float,
    *,
    scale: float | None = None,
    outliers: float = 0.0,
    outlier_tolerance: float = 0.0,
    name: str = "tensor",
) -> None:
    """Assert errors within ``tolerance``, but for a fraction ``outliers``, rounded up, within the other."""
    error = error_to_scale(actual, expected, scale)
    if error.numel() == 0:
        return
    limit = max(tolerance, outlier_tolerance) if outliers > 0 else tolerance
    worst = float(error.max())
    assert worst <= limit, f"{name}: worst error {worst:.3g} of the scale, {limit:.3g} allowed"
    beyond = int((error > tolerance).sum())
    allowed = math.ceil(outliers * error.numel())
    assert beyond <= allowed, f"{name}: {beyond} elements are off by more than {tolerance:.3g}, {allowed} allowed"
