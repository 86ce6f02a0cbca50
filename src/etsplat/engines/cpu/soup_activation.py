"""The CPU engine's side of `soup_activation`: csrc/cpu/bind_soup_activation.cpp."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from etsplat import _native
from etsplat.core.cameras import Cameras
from etsplat.core.validation import dense
from etsplat.engines.native.pool import empty_image


def soup_activation(
    vertices: Tensor,
    opacity_logits: Tensor,
    sigma_raw: Tensor,
    limits: tuple[float, float] | Tensor,
    camera: Cameras | None,
    smallest: float,
    largest: float,
) -> tuple[Tensor, Tensor]:
    """See `Engine.soup_activation`."""
    view = (None, None) if camera is None else (dense(camera.viewmats, "viewmats"), dense(camera.Ks, "Ks"))
    drawn: Any = _SoupActivation.apply(vertices.detach(), opacity_logits, sigma_raw, *view, (smallest, largest), limits)
    return drawn


class _SoupActivation(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        vertices: Tensor,
        logits: Tensor,
        raw: Tensor,
        viewmat: Tensor | None,
        K: Tensor | None,
        sizes: tuple[float, float],
        limits: tuple[float, float],
    ) -> tuple[Tensor, Tensor]:
        inputs = dense(vertices), dense(logits), dense(raw)
        opacities, sigma = empty_image(len(logits)), empty_image(len(logits))
        view = (0 if tensor is None else tensor.data_ptr() for tensor in (viewmat, K))
        addresses = *(tensor.data_ptr() for tensor in inputs), *view
        _native.soup_activate(len(logits), *addresses, *sizes, *limits, opacities.data_ptr(), sigma.data_ptr())
        ctx.save_for_backward(*inputs[1:], opacities)
        ctx.limits = limits
        ctx.set_materialize_grads(False)
        return opacities, sigma

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *cotangents: Tensor | None) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        saved = [dense(tensor) for tensor in ctx.saved_tensors]
        given = [None if tensor is None else dense(tensor) for tensor in cotangents]
        grads = empty_image(len(saved[0])), empty_image(len(saved[0]))
        addresses = (0 if tensor is None else tensor.data_ptr() for tensor in (*given, *grads))
        _native.soup_activate_backward(len(grads[0]), *(tensor.data_ptr() for tensor in saved), *ctx.limits, *addresses)
        return None, *grads, None, None, None, None
