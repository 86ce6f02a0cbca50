"""The GPU engine's side of what a soup is drawn from: soup_activation.cu, soup_colors.cu, spherical_harmonics.cu."""

import ctypes
from typing import Any

import torch
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.core.soup_numbers import SoupNumbers
from etsplat.core.validation import dense
from etsplat.engines.cuda.launch import launch_each, upload
from etsplat.engines.cuda.program import Program
from etsplat.engines.cuda.structs import constant, struct_class
from etsplat.engines.native.operation import differentiable

_ACTIVATION = Program("soup_activation.cu")
_HARMONICS_THREADS = constant("cuda/staged_rows.h", "kThreads")


def _activation(
    _keep: bool,
    vertices: Tensor,
    logits: Tensor,
    raw: Tensor,
    numbers: SoupNumbers | Tensor,
    camera: Cameras | None,
    smallest: float,
    largest: float,
) -> tuple[tuple[Tensor, Tensor], Any]:
    numbers = numbers if isinstance(numbers, Tensor) else upload(numbers, vertices.device)
    view = (None, None) if camera is None else (dense(camera.viewmats, "viewmats"), dense(camera.Ks, "Ks"))
    opacities, sigma = torch.empty_like(logits), torch.empty_like(raw)
    arguments = (len(logits), vertices, logits, raw, *view, smallest, largest, numbers, opacities, sigma)
    launch_each(_ACTIVATION, "soup_activate", len(logits), arguments)
    return (opacities, sigma), (logits, raw, opacities, numbers)


def _activation_backward(saved: Any, _needed: Any, *cotangents: Tensor | None) -> tuple[None, Tensor, Tensor]:
    grads, count = (torch.empty_like(saved[0]), torch.empty_like(saved[0])), len(saved[0])
    launch_each(_ACTIVATION, "soup_activate_backward", count, (count, *saved, *cotangents, *grads))
    return None, *grads


soup_activation = differentiable(_activation, _activation_backward)


def _harmonics(_keep: bool, coefficients: Tensor, directions: Tensor, degree: int) -> tuple[Tensor, Any]:
    """Colours of points along directions."""
    colors = directions.new_empty((*directions.shape[:-1], coefficients.shape[2]))
    _on_points(degree, "sh_forward", coefficients, directions, colors)
    return colors, (degree, coefficients, directions, colors)


def _harmonics_backward(kept: Any, _needed: Any, grad_colors: Tensor) -> tuple[Tensor, Tensor]:
    """Through the clamp, the polynomials and the normalisation."""
    degree, coefficients, directions, colors = kept
    grads = torch.empty_like(coefficients), torch.empty_like(directions)
    _on_points(degree, "sh_backward", coefficients, directions, colors, grad_colors, *grads)
    return grads


def _on_points(degree: int, kernel: str, coefficients: Tensor, directions: Tensor, *others: Tensor) -> None:
    points, bases, channels = coefficients.shape
    views = len(directions) if directions.ndim == 3 else 1
    program = Program("spherical_harmonics.cu", (("DEGREE", degree), ("BASES", bases), ("CHANNELS", channels)))
    arguments = (coefficients, directions, ctypes.c_int64(points), views, *others)
    launch_each(program, kernel, points, arguments, _HARMONICS_THREADS)


spherical_harmonics = differentiable(_harmonics, _harmonics_backward)


def _colors(
    _keep: bool, vertices: Tensor, dc: Tensor, rest: Tensor, centers: Tensor, degree: int
) -> tuple[Tensor, Any]:
    """Colours of triangles as cameras see them."""
    colors = vertices.new_empty((len(centers), len(vertices), 3))
    sizes = ctypes.c_int64(len(vertices)), len(centers)
    _on_triangles(degree, rest, "soup_forward", vertices, dc, rest, centers, *sizes, colors)
    return colors, (degree, dc, vertices, rest, centers, *sizes, colors)


def _colors_backward(kept: Any, _needed: Any, grad_colors: Tensor) -> list[Tensor]:
    """Zero for triangles that no view sees."""
    degree, dc, vertices, rest, *others = kept
    grads = [torch.empty_like(tensor) for tensor in (vertices, dc, rest)]
    _on_triangles(degree, rest, "soup_backward", vertices, rest, *others, grad_colors, *grads)
    return grads


def colors_adam(
    grad_colors: Tensor,
    colors: Tensor,
    of: tuple[Tensor, Tensor, Tensor],
    centers: Tensor,
    degree: int,
    moments: tuple[Tensor, Tensor],
    numbers: tuple[Tensor, Tensor, Tensor | None],
    betas: tuple[float, float],
    eps: float,
    halted: Tensor,
) -> tuple[Tensor, Tensor]:
    """The gradients of `soup_colors` by its first two arguments, and a step of Adam on the third, without its gradient.

    Args:
        grad_colors: (B, N, 3), like the colours.
        colors: that it gave.
        of: its first three arguments; the third, which is contiguous, is updated.
        centers: its fourth.
        degree: its last.
        moments: both of the third.
        numbers: its step size, the correction of the second moment and its decay or None, all (1,) in device memory.
        betas: of Adam.
        eps: of Adam.
        halted: () int32 in device memory: nothing is updated, and the gradients are anything, where it is not 0.
    """
    grad_colors, vertices, dc, centers = (dense(tensor) for tensor in (grad_colors, *of[:2], centers))
    rest, (first_beta, second_beta) = of[2], betas
    grads = torch.empty_like(vertices), torch.empty_like(dc)
    constants = 1 - first_beta, second_beta, 1 - second_beta, eps
    step = struct_class("cuda/soup_colors.cu", "RestStep")(*moments, *numbers, *constants, halted)
    sizes = ctypes.c_int64(len(vertices)), len(centers)
    _on_triangles(degree, rest, "soup_adam", vertices, rest, centers, *sizes, colors, grad_colors, *grads, step)
    return grads


def _on_triangles(degree: int, rest: Tensor, kernel: str, *arguments: Any) -> None:
    program = Program("soup_colors.cu", (("DEGREE", degree), ("BASES", rest.shape[1])))
    launch_each(program, kernel, len(rest), arguments, _HARMONICS_THREADS)


soup_colors = differentiable(_colors, _colors_backward)
