"""The CPU engine's side of `mean_area`: csrc/cpu/bind_triangle_area.cpp."""

from typing import Any

from torch import Tensor

from etsplat import _native
from etsplat.engines.native.operation import differentiable
from etsplat.engines.native.pool import empty_image


def _forward(_keep: bool, vertices: Tensor) -> tuple[Tensor, Any]:
    """One pass computes the value and the gradient, which waits for backward."""
    gradient = empty_image(*vertices.shape)
    mean = _native.mean_area(vertices=vertices, gradient=gradient)
    return vertices.new_tensor(mean), [gradient]


def _backward(kept: Any, _needed: Any, grad_area: Tensor) -> tuple[Tensor]:
    (gradient,) = kept
    return (gradient * grad_area,)


mean_area = differentiable(_forward, _backward)
