"""Colours of a triangle soup as cameras see it: spherical harmonics along the line of sight to each centroid."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat import _native
from etsplat.core.validation import check_like, check_shape, dense
from etsplat.ops._spherical_harmonics_cuda import SoupColorsCuda
from etsplat.ops.engines import resolve_engine
from etsplat.ops.pool import empty_image
from etsplat.ops.spherical_harmonics import MAX_DEGREE, spherical_harmonics

_MAX_REST = (MAX_DEGREE + 1) ** 2 - 1


def soup_colors(
    vertices: Float[Tensor, "N 3 3"],
    sh_dc: Float[Tensor, "N 1 3"],
    sh_rest: Float[Tensor, "N R 3"],
    centers: Float[Tensor, "B 3"],
    degree: int,
    *,
    engine: str | None = None,
) -> Float[Tensor, "B N 3"]:
    """Evaluates max(0, 1/2 + sum_k Y_k(d) c_k), d from the camera to the mean of the triangle's corners.

    Args:
        vertices: (N, 3, 3) corners in world space.
        sh_dc: (N, 1, 3) coefficient of the constant band.
        sh_rest: (N, R, 3) those of the other bands, R >= (degree + 1)^2 - 1; bands above ``degree`` get zero gradient.
        centers: (B, 3) camera positions; they receive no gradient.
        degree: 0 to 3.
        engine: "cpu", "cuda", "reference" or None (by dtype and device).

    Returns:
        (B, N, 3), at least 0. Gradients reach the first three tensors; there is none where the colour was clamped.

    Raises:
        ValueError: Wrong shape, dtype, device or degree; the message names the argument.
    """
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"degree must be from 0 to {MAX_DEGREE}, got {degree}")
    N = len(vertices)
    check_shape("vertices", vertices, ("N", 3, 3))
    check_shape("sh_dc", sh_dc, (N, 1, 3))
    check_shape("sh_rest", sh_rest, (N, "R", 3))
    check_shape("centers", centers, ("B", 3))
    for name, tensor in (("sh_dc", sh_dc), ("sh_rest", sh_rest), ("centers", centers)):
        check_like(name, tensor, "vertices", vertices)
    if sh_rest.shape[1] < (degree + 1) ** 2 - 1:
        raise ValueError(f"sh_rest must have {(degree + 1) ** 2 - 1} bases for degree {degree}, got {sh_rest.shape[1]}")
    chosen = resolve_engine(engine, vertices)
    if chosen != "reference":
        native = SoupColorsCuda if chosen == "cuda" else _SoupColors
        colors: Any = native.apply(vertices, sh_dc, sh_rest[:, :_MAX_REST], centers, degree)
        return colors
    directions = vertices.mean(dim=1) - centers[:, None].detach()
    return spherical_harmonics(torch.cat([sh_dc, sh_rest], dim=1), directions, degree, engine=engine)


class _SoupColors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, vertices: Tensor, dc: Tensor, rest: Tensor, centers: Tensor, degree: int) -> Tensor:
        inputs = [dense(tensor) for tensor in (vertices, dc, rest, centers)]
        colors = empty_image(len(centers), len(vertices), 3)
        _native.soup_colors(*_problem(inputs, degree), colors.data_ptr())
        ctx.save_for_backward(*inputs, colors)
        ctx.degree = degree
        return colors

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad_colors: Tensor) -> tuple[Tensor, Tensor, Tensor, None, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        *inputs, colors = map(dense, ctx.saved_tensors)
        grad_colors = dense(grad_colors)
        grads = [empty_image(*tensor.shape) for tensor in inputs[:3]]
        _native.soup_colors_backward(
            *_problem(inputs, ctx.degree),
            colors.data_ptr(),
            grad_colors.data_ptr(),
            *(grad.data_ptr() for grad in grads),
        )
        return grads[0], grads[1], grads[2], None, None


def _problem(inputs: list[Tensor], degree: int) -> tuple[int, ...]:
    vertices, _, rest, centers = inputs
    return *(tensor.data_ptr() for tensor in inputs), len(vertices), len(centers), rest.shape[1], degree
