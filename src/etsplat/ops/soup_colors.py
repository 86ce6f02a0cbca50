"""Colours of a triangle soup as cameras see it: spherical harmonics along the line of sight to each centroid."""

from contextvars import ContextVar, Token
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.harmonics import MAX_DEGREE, MAX_REST
from etsplat.core.precision import as_given
from etsplat.core.validation import check_like, check_shape
from etsplat.engines.choice import engine_for


@as_given
def soup_colors(
    vertices: Float[Tensor, "N 3 3"],
    sh_dc: Float[Tensor, "N 1 3"],
    sh_rest: Float[Tensor, "N R 3"],
    centers: Float[Tensor, "B 3"],
    degree: int,
) -> Float[Tensor, "B N 3"]:
    """Evaluates max(0, 1/2 + sum_k Y_k(d) c_k), d from the camera to the mean of the triangle's corners.

    Args:
        vertices: (N, 3, 3) corners in world space.
        sh_dc: (N, 1, 3) coefficient of the constant band.
        sh_rest: (N, R, 3) those of the other bands, R >= (degree + 1)^2 - 1; bands above ``degree`` get zero gradient.
        centers: (B, 3) camera positions.
        degree: 0 to 3.

    Returns:
        (B, N, 3), at least 0. Gradients reach all tensors, within `EndAtColors` none of them; there is none where the
        colour was clamped.

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
    engine, ending, rest = engine_for(vertices), _ending.get(), sh_rest[:, :MAX_REST]
    if ending is not None and torch.is_grad_enabled() and ending.takes(vertices, sh_dc, sh_rest):
        return ending.taken(engine.soup_colors(vertices, sh_dc, rest, centers.detach(), degree), centers, degree)
    if not (centers.requires_grad and torch.is_grad_enabled()):
        return engine.soup_colors(vertices, sh_dc, rest, centers, degree)
    # Engines have no gradient to cameras, but to corners: so these are seen from where each camera is, one by one.
    origin = torch.zeros_like(centers[:1])
    views = [engine.soup_colors(vertices - center, sh_dc, rest, origin, degree) for center in centers]
    return torch.cat(views) if views else vertices.new_empty((0, N, 3))


class EndAtColors:
    """Within the block gradients end at the colours that `soup_colors` makes of these tensors, the first time.

    So whoever gets the gradient of a view's colours, three numbers for each triangle, can carry it on to the
    coefficients, which are up to 48, in another place (`colors_backward`).

    Attributes:
        of: the tensors: corners, and the coefficients of the constant band and of the others.
        colors: (B, N, 3) leaf, which gets the gradient; None before it was made.
        again: whether colours were made of them once more, whose gradients went on.
        centers: (B, 3) positions of the cameras.
        degree: of the harmonics.
    """

    def __init__(self, vertices: Tensor, sh_dc: Tensor, sh_rest: Tensor) -> None:
        """Takes the tensors, which are recognised by being the same objects."""
        self.of = (vertices, sh_dc, sh_rest)
        self.colors: Tensor | None = None
        self.again = False
        self.centers, self.degree = vertices.new_empty((0, 3)), 0

    def __enter__(self) -> "EndAtColors":
        self._token: Token[EndAtColors | None] = _ending.set(self)
        return self

    def __exit__(self, *_: Any) -> None:
        _ending.reset(self._token)

    def takes(self, *of: Tensor) -> bool:
        """Whether the gradient ends at colours of these tensors: at the first of its own; `again` tells of others."""
        if any(one is not other for one, other in zip(of, self.of, strict=True)):
            return False
        self.again = self.again or self.colors is not None
        return self.colors is None

    def taken(self, colors: Tensor, centers: Tensor, degree: int) -> Tensor:
        """A leaf in the place of colours, unless nothing wants their gradient."""
        if not colors.requires_grad:
            return colors
        self.colors, self.centers, self.degree = colors.detach().requires_grad_(), centers.detach(), degree
        return self.colors


_ending: ContextVar[EndAtColors | None] = ContextVar("etsplat.ending", default=None)


def colors_backward(
    grad_colors: Float[Tensor, "B N 3"],
    vertices: Float[Tensor, "N 3 3"],
    sh_dc: Float[Tensor, "N 1 3"],
    sh_rest: Float[Tensor, "N R 3"],
    centers: Float[Tensor, "B 3"],
    degree: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """The gradients by the first three arguments of `soup_colors`, from that by its result: to the bit autograd's.

    Args:
        grad_colors: (B, N, 3).
        vertices: (N, 3, 3), as there, like all that follow.
        sh_dc: (N, 1, 3).
        sh_rest: (N, R, 3).
        centers: (B, 3).
        degree: 0 to 3.
    """
    with torch.enable_grad():
        corners, dc, rest = (tensor.detach().requires_grad_() for tensor in (vertices, sh_dc, sh_rest))
        colors = soup_colors(corners, dc, rest, centers, degree)
    by_vertices, by_dc, by_rest = torch.autograd.grad(colors, (corners, dc, rest), grad_colors)
    return by_vertices, by_dc, by_rest
