"""The CPU engine's side of `spherical_harmonics` and `soup_colors`."""

from typing import Any

import torch
from torch import Tensor

from etsplat import _native
from etsplat.engines.native.operation import differentiable
from etsplat.engines.native.pool import empty_image


def _forward(_keep: bool, coefficients: Tensor, directions: Tensor, degree: int) -> tuple[Tensor, Any]:
    colors = directions.new_empty((*directions.shape[:-1], coefficients.shape[2]))
    _native.spherical_harmonics(*_problem(coefficients, directions, degree), colors.data_ptr())
    return colors, (coefficients, directions, degree, colors)


def _backward(kept: Any, _needed: Any, grad_colors: Tensor) -> tuple[Tensor, Tensor]:
    *inputs, colors = kept
    grads = torch.empty_like(inputs[0]), torch.empty_like(inputs[1])
    images = (colors, grad_colors, *grads)
    _native.spherical_harmonics_backward(*_problem(*inputs), *(tensor.data_ptr() for tensor in images))
    return grads


def _problem(coefficients: Tensor, directions: Tensor, degree: int) -> tuple[int, ...]:
    points, bases, channels = coefficients.shape
    views = len(directions) if directions.ndim == 3 else 1
    return coefficients.data_ptr(), directions.data_ptr(), points, views, bases, channels, degree


spherical_harmonics = differentiable(_forward, _backward)


def _soup_forward(
    _keep: bool, vertices: Tensor, dc: Tensor, rest: Tensor, centers: Tensor, degree: int
) -> tuple[Tensor, Any]:
    inputs = vertices, dc, rest, centers
    colors = empty_image(len(centers), len(vertices), 3)
    _native.soup_colors(*_soup_problem(inputs, degree), colors.data_ptr())
    return colors, (*inputs, colors, degree)


def _soup_backward(kept: Any, _needed: Any, grad_colors: Tensor) -> list[Tensor]:
    *inputs, colors, degree = kept
    grads = [empty_image(*tensor.shape) for tensor in inputs[:3]]
    images = (colors, grad_colors, *grads)
    _native.soup_colors_backward(*_soup_problem(inputs, degree), *(tensor.data_ptr() for tensor in images))
    return grads


def _soup_problem(inputs: Any, degree: int) -> tuple[int, ...]:
    vertices, _, rest, centers = inputs
    return *(tensor.data_ptr() for tensor in inputs), len(vertices), len(centers), rest.shape[1], degree


soup_colors = differentiable(_soup_forward, _soup_backward)
