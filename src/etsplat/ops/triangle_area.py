"""The mean area of separate triangles, for the size loss of novel-view synthesis."""

import ctypes
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat import _native
from etsplat.core.validation import check_shape, dense
from etsplat.cuda.launch import blocks, launch
from etsplat.cuda.program import Program
from etsplat.ops.engines import resolve_engine
from etsplat.ops.pool import empty_image

_PROGRAM = Program("triangle_area.cu", contract=False)
_THREADS = 256


def mean_area(vertices: Float[Tensor, "N 3 3"], *, engine: str | None = None) -> Float[Tensor, ""]:
    """Mean of |(v1 - v0) x (v2 - v0)| / 2.

    Args:
        vertices: (N, 3, 3), N > 0. A triangle without area gets no gradient.
        engine: "cpu", "cuda", "reference" or None (by dtype and device).

    Returns:
        Scalar. The native engines add in a fixed order: the same bits in every run.

    Raises:
        ValueError: Wrong shape, dtype or device; no triangle.
    """
    check_shape("vertices", vertices, ("N", 3, 3))
    if len(vertices) == 0:
        raise ValueError("vertices must hold at least one triangle, got 0")
    chosen = resolve_engine(engine, vertices)
    if chosen != "reference":
        native = _MeanAreaOnDevice if chosen == "cuda" else _MeanArea
        area: Any = native.apply(vertices)
        return area
    first, second = vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0]
    return 0.5 * torch.linalg.cross(first, second).norm(dim=1).mean()


class _MeanArea(torch.autograd.Function):
    """One pass computes the value and the gradient, which waits for backward."""

    @staticmethod
    def forward(ctx: Any, vertices: Tensor) -> Tensor:
        vertices = dense(vertices, "vertices")
        gradient = empty_image(*vertices.shape)
        mean = _native.mean_area(vertices.data_ptr(), len(vertices), gradient.data_ptr())
        ctx.save_for_backward(gradient)
        return vertices.new_tensor(mean)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad_area: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        (gradient,) = ctx.saved_tensors
        return gradient * grad_area


class _MeanAreaOnDevice(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, vertices: Tensor) -> Tensor:
        vertices = dense(vertices, "vertices")
        grid = blocks(len(vertices), _THREADS)
        sums, mean = vertices.new_empty(grid, dtype=torch.float64), vertices.new_empty(())
        launch(_PROGRAM, "area_sums", grid, _THREADS, (vertices, len(vertices), sums))
        launch(_PROGRAM, "area_mean", 1, _THREADS, (sums, ctypes.c_int64(grid), len(vertices), mean))
        ctx.save_for_backward(vertices)
        return mean

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad_area: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        """``grad_area`` stays in device memory."""
        vertices = dense(ctx.saved_tensors[0])
        gradient = torch.empty_like(vertices)
        arguments = (vertices, len(vertices), dense(grad_area), gradient)
        launch(_PROGRAM, "area_backward", blocks(len(vertices), _THREADS), _THREADS, arguments)
        return gradient
