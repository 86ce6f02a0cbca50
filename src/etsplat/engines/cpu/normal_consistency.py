"""The CPU engine's side of `normal_consistency`: csrc/cpu/bind_normals.cpp, one view after the other."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from etsplat import _native
from etsplat.core.validation import dense
from etsplat.engines.native.pool import empty_image


def normal_consistency(normals: Tensor, depth: Tensor, alpha: Tensor, viewmats: Tensor, Ks: Tensor) -> Tensor:
    """See `Engine.normal_consistency`."""
    loss: Any = _NormalConsistency.apply(normals, depth, alpha.detach(), viewmats.detach(), Ks.detach())
    return loss


class _NormalConsistency(torch.autograd.Function):
    """One pass computes the value and the derivatives, which wait for backward."""

    @staticmethod
    def forward(ctx: Any, *given: Tensor) -> Tensor:
        inputs = [dense(tensor) for tensor in given]
        normals, depth = inputs[:2]
        height, width = normals.shape[1:3]
        derivatives = [empty_image(*tensor.shape) for tensor in (normals, depth) if any(ctx.needs_input_grad)]
        total = 0.0
        for b in range(len(normals)):
            views = (tensor[b].data_ptr() for tensor in inputs)
            outputs = [tensor[b].data_ptr() for tensor in derivatives] or [0, 0]
            total += _native.normal_agreement(*views, height, width, *outputs)
        ctx.save_for_backward(*derivatives)
        return normals.new_tensor(1.0 - total / depth.numel())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_loss: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        derivatives = ctx.saved_tensors
        scale = -float(grad_loss) / derivatives[1].numel()
        grads = (torch.mul(tensor, scale, out=empty_image(*tensor.shape)) for tensor in derivatives)
        return *grads, None, None, None
