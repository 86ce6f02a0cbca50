"""The mean area of separate triangles, for the size loss of novel-view synthesis."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat import _native
from etsplat.core.validation import check_shape
from etsplat.ops.engines import resolve_engine
from etsplat.ops.pool import empty_image


def mean_area(vertices: Float[Tensor, "N 3 3"], *, engine: str | None = None) -> Float[Tensor, ""]:
    """Mean of |(v1 - v0) x (v2 - v0)| / 2.

    Args:
        vertices: (N, 3, 3), N > 0. A triangle without area gets no gradient.
        engine: "cpu", "reference" or None (by dtype and device).

    Returns:
        Scalar. The native engine adds in a fixed order: the same bits for any number of threads.

    Raises:
        ValueError: Wrong shape, dtype or device; no triangle.
    """
    check_shape("vertices", vertices, ("N", 3, 3))
    if len(vertices) == 0:
        raise ValueError("vertices must hold at least one triangle, got 0")
    if resolve_engine(engine, vertices) == "cpu":
        area: Any = _MeanArea.apply(vertices)
        return area
    first, second = vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0]
    return 0.5 * torch.linalg.cross(first, second).norm(dim=1).mean()


class _MeanArea(torch.autograd.Function):
    """One pass computes the value and the gradient, which waits for backward."""

    @staticmethod
    def forward(ctx: Any, vertices: Tensor) -> Tensor:
        vertices = vertices.contiguous()
        gradient = empty_image(*vertices.shape)
        mean = _native.mean_area(vertices.data_ptr(), len(vertices), gradient.data_ptr())
        ctx.save_for_backward(gradient)
        return vertices.new_tensor(mean)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad_area: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        (gradient,) = ctx.saved_tensors
        return gradient * grad_area
