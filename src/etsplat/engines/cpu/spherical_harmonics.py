"""The CPU engine's side of `spherical_harmonics` and `soup_colors`."""

from typing import Any

import torch
from torch import Tensor

from etsplat import _native
from etsplat.engines.native.operation import differentiable
from etsplat.engines.native.pool import empty_image


def _forward(_keep: bool, coefficients: Tensor, directions: Tensor, degree: int) -> tuple[Tensor, Any]:
    colors = directions.new_empty((*directions.shape[:-1], coefficients.shape[2]))
    _native.spherical_harmonics(coefficients=coefficients, directions=directions, degree=degree, colors=colors)
    return colors, (coefficients, directions, degree, colors)


def _backward(kept: Any, _needed: Any, grad_colors: Tensor) -> tuple[Tensor, Tensor]:
    coefficients, directions, degree, colors = kept
    grad_coefficients, grad_directions = torch.empty_like(coefficients), torch.empty_like(directions)
    _native.spherical_harmonics_backward(
        coefficients=coefficients,
        directions=directions,
        degree=degree,
        colors=colors,
        grad_colors=grad_colors,
        grad_coefficients=grad_coefficients,
        grad_directions=grad_directions,
    )
    return grad_coefficients, grad_directions


spherical_harmonics = differentiable(_forward, _backward)


def _soup_forward(
    _keep: bool, vertices: Tensor, dc: Tensor, rest: Tensor, centers: Tensor, degree: int
) -> tuple[Tensor, Any]:
    colors = empty_image(len(centers), len(vertices), 3)
    _native.soup_colors(corners=vertices, dc=dc, rest=rest, centers=centers, degree=degree, colors=colors)
    return colors, (vertices, dc, rest, centers, degree, colors)


def _soup_backward(kept: Any, _needed: Any, grad_colors: Tensor) -> list[Tensor]:
    vertices, dc, rest, centers, degree, colors = kept
    grads = [empty_image(*tensor.shape) for tensor in (vertices, dc, rest)]
    _native.soup_colors_backward(
        corners=vertices,
        dc=dc,
        rest=rest,
        centers=centers,
        degree=degree,
        colors=colors,
        grad_colors=grad_colors,
        grad_corners=grads[0],
        grad_dc=grads[1],
        grad_rest=grads[2],
    )
    return grads


soup_colors = differentiable(_soup_forward, _soup_backward)
