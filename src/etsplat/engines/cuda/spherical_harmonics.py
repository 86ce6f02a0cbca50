"""The GPU engine's side of ``spherical_harmonics`` and ``soup_colors``: csrc/cuda/spherical_harmonics.cu."""

import ctypes
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from etsplat.core.harmonics import MAX_REST
from etsplat.core.validation import dense
from etsplat.engines.cuda.launch import blocks, launch
from etsplat.engines.cuda.program import Program

_PROGRAM = Program("spherical_harmonics.cu")
_THREADS = 64


def spherical_harmonics(coefficients: Tensor, directions: Tensor, degree: int) -> Tensor:
    """See `Engine.spherical_harmonics`."""
    colors: Any = _SphericalHarmonics.apply(coefficients, directions, degree)
    return colors


def soup_colors(vertices: Tensor, sh_dc: Tensor, sh_rest: Tensor, centers: Tensor, degree: int) -> Tensor:
    """See `Engine.soup_colors`."""
    colors: Any = _SoupColors.apply(vertices, sh_dc, sh_rest[:, :MAX_REST], centers, degree)
    return colors


class _SphericalHarmonics(torch.autograd.Function):
    """Colours of points along directions."""

    @staticmethod
    def forward(ctx: Any, coefficients: Tensor, directions: Tensor, degree: int) -> Tensor:
        inputs = dense(coefficients), dense(directions)
        colors = directions.new_empty((*directions.shape[:-1], coefficients.shape[2]))
        _run("sh_forward", len(coefficients), (*inputs, *_sizes(*inputs, degree), colors))
        ctx.save_for_backward(*inputs, colors)
        ctx.degree = degree
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_colors: Tensor) -> tuple[Tensor, Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Through the clamp, the polynomials and the normalisation."""
        coefficients, directions, colors = map(dense, ctx.saved_tensors)
        grads = torch.empty_like(coefficients), torch.empty_like(directions)
        sizes = _sizes(coefficients, directions, ctx.degree)
        arguments = (coefficients, directions, *sizes, colors, dense(grad_colors), *grads)
        _run("sh_backward", len(coefficients), arguments)
        return *grads, None


class _SoupColors(torch.autograd.Function):
    """Colours of triangles as cameras see them."""

    @staticmethod
    def forward(ctx: Any, vertices: Tensor, dc: Tensor, rest: Tensor, centers: Tensor, degree: int) -> Tensor:
        inputs = [dense(tensor) for tensor in (vertices, dc, rest, centers)]
        colors = vertices.new_empty((len(centers), len(vertices), 3))
        _run("soup_forward", len(vertices), (*inputs, *_soup_sizes(inputs, degree), colors))
        ctx.save_for_backward(*inputs, colors)
        ctx.degree = degree
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_colors: Tensor) -> tuple[Tensor, Tensor, Tensor, None, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Zero for triangles that no view sees."""
        *inputs, colors = map(dense, ctx.saved_tensors)
        vertices, _, rest, centers = inputs
        grads = [torch.empty_like(tensor) for tensor in inputs[:3]]
        sizes = _soup_sizes(inputs, ctx.degree)
        arguments = (vertices, rest, centers, *sizes, colors, dense(grad_colors), *grads)
        _run("soup_backward", len(vertices), arguments)
        return grads[0], grads[1], grads[2], None, None


def _run(name: str, points: int, arguments: tuple[Any, ...]) -> None:
    launch(_PROGRAM, name, blocks(points, _THREADS), _THREADS, arguments)


def _sizes(coefficients: Tensor, directions: Tensor, degree: int) -> tuple[Any, ...]:
    """Points, views, bases, channels, degree."""
    points, bases, channels = coefficients.shape
    views = len(directions) if directions.ndim == 3 else 1
    return ctypes.c_int64(points), views, bases, channels, degree


def _soup_sizes(inputs: list[Tensor], degree: int) -> tuple[Any, ...]:
    """Triangles, views, bases, degree."""
    vertices, _, rest, centers = inputs
    return ctypes.c_int64(len(vertices)), len(centers), rest.shape[1], degree
