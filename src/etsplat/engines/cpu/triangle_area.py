"""The CPU engine's side of `mean_area`: csrc/cpu/bind_triangle_area.cpp."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from etsplat import _native
from etsplat.core.validation import dense
from etsplat.engines.native.pool import empty_image


def mean_area(vertices: Tensor) -> Tensor:
    """See `Engine.mean_area`."""
    area: Any = _MeanArea.apply(vertices)
    return area


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
    @once_differentiable
    def backward(ctx: Any, grad_area: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        (gradient,) = ctx.saved_tensors
        return gradient * grad_area
