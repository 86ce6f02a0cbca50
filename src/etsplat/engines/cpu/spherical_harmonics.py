"""The CPU engine's side of `spherical_harmonics` and `soup_colors`."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from etsplat import _native
from etsplat.core.harmonics import MAX_REST
from etsplat.core.validation import dense
from etsplat.engines.native.pool import empty_image


def spherical_harmonics(coefficients: Tensor, directions: Tensor, degree: int) -> Tensor:
    """See `Engine.spherical_harmonics`."""
    colors: Any = _SphericalHarmonics.apply(coefficients, directions, degree)
    return colors


def soup_colors(vertices: Tensor, sh_dc: Tensor, sh_rest: Tensor, centers: Tensor, degree: int) -> Tensor:
    """See `Engine.soup_colors`."""
    colors: Any = _SoupColors.apply(vertices, sh_dc, sh_rest[:, :MAX_REST], centers, degree)
    return colors


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
    @once_differentiable
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


class _SoupColors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, vertices: Tensor, dc: Tensor, rest: Tensor, centers: Tensor, degree: int) -> Tensor:
        inputs = [dense(tensor) for tensor in (vertices, dc, rest, centers)]
        colors = empty_image(len(centers), len(vertices), 3)
        _native.soup_colors(*_soup_problem(inputs, degree), colors.data_ptr())
        ctx.save_for_backward(*inputs, colors)
        ctx.degree = degree
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_colors: Tensor) -> tuple[Tensor, Tensor, Tensor, None, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        *inputs, colors = map(dense, ctx.saved_tensors)
        grad_colors = dense(grad_colors)
        grads = [empty_image(*tensor.shape) for tensor in inputs[:3]]
        _native.soup_colors_backward(
            *_soup_problem(inputs, ctx.degree),
            colors.data_ptr(),
            grad_colors.data_ptr(),
            *(grad.data_ptr() for grad in grads),
        )
        return grads[0], grads[1], grads[2], None, None


def _soup_problem(inputs: list[Tensor], degree: int) -> tuple[int, ...]:
    vertices, _, rest, centers = inputs
    return *(tensor.data_ptr() for tensor in inputs), len(vertices), len(centers), rest.shape[1], degree
