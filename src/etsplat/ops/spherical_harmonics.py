"""View-dependent colour by real spherical harmonics up to degree 3, with the convention of 3D Gaussian splatting.

    color = max(0, 1/2 + sum_k Y_k(d / |d|) c_k)

with the bands l = 0..degree one after the other, m = -l..l within each, and the Condon-Shortley sign (Y_1 ~ -y, z, -x).
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat import _native
from etsplat.core.validation import check_like, check_shape, dense
from etsplat.ops._spherical_harmonics_cuda import SphericalHarmonicsCuda
from etsplat.ops.engines import resolve_engine

MAX_DEGREE = 3
_MIN_LENGTH = 1e-12


def spherical_harmonics(
    coefficients: Float[Tensor, "N K C"],
    directions: Float[Tensor, "N 3"] | Float[Tensor, "B N 3"],
    degree: int,
    *,
    engine: str | None = None,
) -> Float[Tensor, "N C"] | Float[Tensor, "B N C"]:
    """Colours of N primitives as seen along ``directions``.

    Args:
        coefficients: (N, K, C) with K >= (degree + 1)^2; bands above ``degree`` are not used and get zero gradient.
        directions: (N, 3), or (B, N, 3) for B views: from the camera to the primitive, of any length. One of length
            1e-12 or less shows the constant band only and gets zero gradient.
        degree: 0 to 3.
        engine: "cpu", "cuda", "reference" or None (by dtype and device).

    Returns:
        (N, C) or (B, N, C), at least 0. Gradients reach both tensors; there is none where the colour was clamped.

    Raises:
        ValueError: Wrong shape, dtype, device or degree; the message names the argument.
    """
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"degree must be from 0 to {MAX_DEGREE}, got {degree}")
    check_shape("coefficients", coefficients, ("N", "K", "C"))
    if coefficients.shape[1] < (degree + 1) ** 2:
        raise ValueError(
            f"coefficients must have at least {(degree + 1) ** 2} bases for degree {degree}, "
            f"got shape {tuple(coefficients.shape)}"
        )
    batch = ("B",) if directions.ndim == 3 else ()
    check_shape("directions", directions, (*batch, len(coefficients), 3))
    check_like("directions", directions, "coefficients", coefficients)
    chosen = resolve_engine(engine, coefficients)
    if chosen != "reference":
        native = SphericalHarmonicsCuda if chosen == "cuda" else _SphericalHarmonics
        colors: Any = native.apply(coefficients, directions, degree)
        return colors
    basis = _basis(directions, degree)
    return torch.relu(0.5 + torch.einsum("...nk,nkc->...nc", basis, coefficients[:, : basis.shape[-1]]))


class _SphericalHarmonics(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, coefficients: Tensor, directions: Tensor, degree: int) -> Tensor:
        coefficients, directions = dense(coefficients, "coefficients"), dense(directions, "directions")
        colors = directions.new_empty((*directions.shape[:-1], coefficients.shape[2]))
        _native.spherical_harmonics(*_problem(coefficients, directions, degree), colors.data_ptr())
        ctx.save_for_backward(coefficients, directions, colors)
        ctx.degree = degree
        return colors

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad_colors: Tensor) -> tuple[Tensor, Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        coefficients, directions, colors = map(dense, ctx.saved_tensors)
        grad_colors = dense(grad_colors)
        grad_coefficients, grad_directions = torch.empty_like(coefficients), torch.empty_like(directions)
        _native.spherical_harmonics_backward(
            *_problem(coefficients, directions, ctx.degree),
            colors.data_ptr(),
            grad_colors.data_ptr(),
            grad_coefficients.data_ptr(),
            grad_directions.data_ptr(),
        )
        return grad_coefficients, grad_directions, None


def _problem(coefficients: Tensor, directions: Tensor, degree: int) -> tuple[int, ...]:
    points, bases, channels = coefficients.shape
    views = len(directions) if directions.ndim == 3 else 1
    return coefficients.data_ptr(), directions.data_ptr(), points, views, bases, channels, degree


def _basis(directions: Tensor, degree: int) -> Float[Tensor, "*batch K"]:
    """Y_k at the normalised directions, (..., (degree + 1)^2); the constant alone where there is no direction."""
    square = directions.square().sum(dim=-1, keepdim=True)
    usable = square > _MIN_LENGTH**2
    x, y, z = torch.where(usable, directions / torch.where(usable, square, 1).sqrt(), 0).unbind(dim=-1)
    xx, yy, zz = x * x, y * y, z * z
    bands = [
        [torch.full_like(x, 0.28209479177387814)],
        [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x],
        [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ],
        [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ],
    ]
    return torch.stack([value for band in bands[: degree + 1] for value in band], dim=-1)
