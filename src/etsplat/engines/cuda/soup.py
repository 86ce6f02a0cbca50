"""The GPU engine's side of what a soup is drawn from: csrc/cuda/soup_activation.cu and spherical_harmonics.cu."""

import ctypes
from typing import Any

import torch
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.core.validation import dense
from etsplat.engines.cuda.launch import launch_each, upload
from etsplat.engines.cuda.program import Program
from etsplat.engines.cuda.structs import constant
from etsplat.engines.native.operation import differentiable

_ACTIVATION = Program("soup_activation.cu")
_HARMONICS = Program("spherical_harmonics.cu")
_HARMONICS_THREADS = constant("cuda/spherical_harmonics.cu", "kThreads")


def _activation(
    _keep: bool,
    vertices: Tensor,
    logits: Tensor,
    raw: Tensor,
    limits: tuple[float, float] | Tensor,
    camera: Cameras | None,
    smallest: float,
    largest: float,
) -> tuple[tuple[Tensor, Tensor], Any]:
    limits = limits if isinstance(limits, Tensor) else upload(limits, vertices.device)
    view = (None, None) if camera is None else (dense(camera.viewmats, "viewmats"), dense(camera.Ks, "Ks"))
    opacities, sigma = torch.empty_like(logits), torch.empty_like(raw)
    arguments = (len(logits), vertices, logits, raw, *view, smallest, largest, limits, opacities, sigma)
    launch_each(_ACTIVATION, "soup_activate", len(logits), arguments)
    return (opacities, sigma), (logits, raw, opacities, limits)


def _activation_backward(saved: Any, _needed: Any, *cotangents: Tensor | None) -> tuple[None, Tensor, Tensor]:
    grads, count = (torch.empty_like(saved[0]), torch.empty_like(saved[0])), len(saved[0])
    launch_each(_ACTIVATION, "soup_activate_backward", count, (count, *saved, *cotangents, *grads))
    return None, *grads


soup_activation = differentiable(_activation, _activation_backward)


def _harmonics(_keep: bool, coefficients: Tensor, directions: Tensor, degree: int) -> tuple[Tensor, Any]:
    """Colours of points along directions."""
    colors = directions.new_empty((*directions.shape[:-1], coefficients.shape[2]))
    sizes = _sizes(coefficients, directions, degree)
    _per_point("sh_forward", coefficients, (coefficients, directions, *sizes, colors))
    return colors, (coefficients, directions, degree, colors)


def _harmonics_backward(kept: Any, _needed: Any, grad_colors: Tensor) -> tuple[Tensor, Tensor]:
    """Through the clamp, the polynomials and the normalisation."""
    *problem, colors = kept
    coefficients, directions, _ = problem
    grads = torch.empty_like(coefficients), torch.empty_like(directions)
    arguments = (coefficients, directions, *_sizes(*problem), colors, grad_colors, *grads)
    _per_point("sh_backward", coefficients, arguments)
    return grads


def _sizes(coefficients: Tensor, directions: Tensor, degree: int) -> tuple[Any, ...]:
    """Points, views, bases, channels, degree."""
    points, bases, channels = coefficients.shape
    views = len(directions) if directions.ndim == 3 else 1
    return ctypes.c_int64(points), views, bases, channels, degree


spherical_harmonics = differentiable(_harmonics, _harmonics_backward)


def _colors(
    _keep: bool, vertices: Tensor, dc: Tensor, rest: Tensor, centers: Tensor, degree: int
) -> tuple[Tensor, Any]:
    """Colours of triangles as cameras see them."""
    colors = vertices.new_empty((len(centers), len(vertices), 3))
    sizes = ctypes.c_int64(len(vertices)), len(centers), rest.shape[1], degree
    _per_point("soup_forward", vertices, (vertices, dc, rest, centers, *sizes, colors))
    return colors, (vertices, dc, rest, centers, *sizes, colors)


def _colors_backward(kept: Any, _needed: Any, grad_colors: Tensor) -> list[Tensor]:
    """Zero for triangles that no view sees."""
    vertices, dc, rest, *constants = kept
    grads = [torch.empty_like(tensor) for tensor in (vertices, dc, rest)]
    _per_point("soup_backward", vertices, (vertices, rest, *constants, grad_colors, *grads))
    return grads


def _per_point(name: str, points: Tensor, arguments: tuple[Any, ...]) -> None:
    launch_each(_HARMONICS, name, len(points), arguments, _HARMONICS_THREADS)


soup_colors = differentiable(_colors, _colors_backward)
