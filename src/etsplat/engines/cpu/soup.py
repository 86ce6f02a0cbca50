"""The CPU engine's side of what a soup is drawn from: csrc/cpu/bind_soup_activation.cpp and the like."""

from typing import Any

import torch
from torch import Tensor

from etsplat import _native
from etsplat.core.cameras import Cameras
from etsplat.core.soup_numbers import SoupNumbers
from etsplat.core.validation import dense
from etsplat.engines.native.operation import differentiable
from etsplat.engines.native.pool import empty_image


def _activation(
    _keep: bool,
    vertices: Tensor,
    logits: Tensor,
    raw: Tensor,
    numbers: SoupNumbers,
    camera: Cameras | None,
    smallest: float,
    largest: float,
) -> tuple[tuple[Tensor, Tensor], Any]:
    opacities, sigma = empty_image(len(logits)), empty_image(len(logits))
    _native.soup_activate(
        vertices=vertices,
        logits=logits,
        raw=raw,
        viewmats=None if camera is None else dense(camera.viewmats, "viewmats"),
        Ks=None if camera is None else dense(camera.Ks, "Ks"),
        smallest=smallest,
        largest=largest,
        numbers=numbers,
        opacities=opacities,
        sigma=sigma,
    )
    return (opacities, sigma), (logits, raw, opacities, numbers)


def _activation_backward(
    kept: Any, _needed: Any, grad_opacities: Tensor | None, grad_sigma: Tensor | None
) -> tuple[None, Tensor, Tensor]:
    logits, raw, opacities, numbers = kept
    grad_logits, grad_raw = empty_image(len(logits)), empty_image(len(raw))
    _native.soup_activate_backward(
        logits=logits,
        raw=raw,
        opacities=opacities,
        numbers=numbers,
        grad_opacities=grad_opacities,
        grad_sigma=grad_sigma,
        grad_logits=grad_logits,
        grad_raw=grad_raw,
    )
    return None, grad_logits, grad_raw


soup_activation = differentiable(_activation, _activation_backward)


def _harmonics(_keep: bool, coefficients: Tensor, directions: Tensor, degree: int) -> tuple[Tensor, Any]:
    colors = directions.new_empty((*directions.shape[:-1], coefficients.shape[2]))
    _native.spherical_harmonics(coefficients=coefficients, directions=directions, degree=degree, colors=colors)
    return colors, (coefficients, directions, degree, colors)


def _harmonics_backward(kept: Any, _needed: Any, grad_colors: Tensor) -> tuple[Tensor, Tensor]:
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


spherical_harmonics = differentiable(_harmonics, _harmonics_backward)


def _colors(
    _keep: bool, vertices: Tensor, dc: Tensor, rest: Tensor, centers: Tensor, degree: int
) -> tuple[Tensor, Any]:
    colors = empty_image(len(centers), len(vertices), 3)
    _native.soup_colors(corners=vertices, dc=dc, rest=rest, centers=centers, degree=degree, colors=colors)
    return colors, (vertices, dc, rest, centers, degree, colors)


def _colors_backward(kept: Any, _needed: Any, grad_colors: Tensor) -> list[Tensor]:
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


soup_colors = differentiable(_colors, _colors_backward)
