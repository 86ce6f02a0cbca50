"""The CPU engine's side of `normal_consistency`: csrc/cpu/bind_normals.cpp, one view after the other."""

from typing import Any

import torch
from torch import Tensor

from etsplat import _native
from etsplat.engines.native.operation import differentiable
from etsplat.engines.native.pool import empty_image


def _forward(keep: bool, *inputs: Tensor) -> tuple[Tensor, Any]:
    """One pass computes the value and the derivatives, which wait for backward."""
    normals, depth = inputs[:2]
    height, width = normals.shape[1:3]
    derivatives = [empty_image(*tensor.shape) for tensor in (normals, depth) if keep]
    total = 0.0
    for b in range(len(normals)):
        views = (tensor[b].data_ptr() for tensor in inputs)
        outputs = [tensor[b].data_ptr() for tensor in derivatives] or [0, 0]
        total += _native.normal_agreement(*views, height, width, *outputs)
    return normals.new_tensor(1.0 - total / depth.numel()), derivatives


def _backward(derivatives: Any, _needed: Any, grad_loss: Tensor) -> list[Tensor]:
    scale = -float(grad_loss) / derivatives[1].numel()
    return [torch.mul(tensor, scale, out=empty_image(*tensor.shape)) for tensor in derivatives]


normal_consistency = differentiable(_forward, _backward)
