"""The CPU engine's side of `normal_consistency`: csrc/cpu/bind_normals.cpp."""

from typing import Any

import torch
from torch import Tensor

from etsplat import _native
from etsplat.engines.native.operation import differentiable
from etsplat.engines.native.pool import empty_image


def _forward(
    keep: bool, normals: Tensor, depth: Tensor, alpha: Tensor, viewmats: Tensor, Ks: Tensor
) -> tuple[Tensor, Any]:
    """One pass computes the value and the derivatives, which wait for backward."""
    by_normals, by_depth = (empty_image(*tensor.shape) if keep else None for tensor in (normals, depth))
    total = _native.normal_agreement(
        normals=normals, depth=depth, alpha=alpha, viewmats=viewmats, Ks=Ks, by_normals=by_normals, by_depth=by_depth
    )
    return normals.new_tensor(1.0 - total / depth.numel()), (by_normals, by_depth)


def _backward(derivatives: Any, _needed: Any, grad_loss: Tensor) -> list[Tensor]:
    scale = -float(grad_loss) / derivatives[1].numel()
    return [torch.mul(tensor, scale, out=empty_image(*tensor.shape)) for tensor in derivatives]


normal_consistency = differentiable(_forward, _backward)
