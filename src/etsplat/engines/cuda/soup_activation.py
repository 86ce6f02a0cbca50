"""The GPU engine's side of `soup_activation`: csrc/cuda/soup_activation.cu."""

import ctypes
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from etsplat.core.cameras import Cameras
from etsplat.core.validation import dense
from etsplat.engines.cuda.launch import blocks, launch
from etsplat.engines.cuda.program import Program
from etsplat.engines.cuda.transfer import upload

_PROGRAM = Program("soup_activation.cu")
_THREADS = 256


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
    if not isinstance(limits, Tensor):
        limits = upload(limits, vertices.device)
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
        limits: Tensor,
    ) -> tuple[Tensor, Tensor]:
        inputs = dense(vertices), dense(logits), dense(raw)
        opacities, sigma = torch.empty_like(inputs[1]), torch.empty_like(inputs[2])
        _launch("soup_activate", len(logits), *inputs, viewmat, K, *sizes, limits, opacities, sigma)
        ctx.save_for_backward(*inputs[1:], opacities, limits)
        ctx.set_materialize_grads(False)
        return opacities, sigma

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *cotangents: Tensor | None) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        saved = [dense(tensor) for tensor in ctx.saved_tensors]
        grads = torch.empty_like(saved[0]), torch.empty_like(saved[0])
        given = (None if tensor is None else dense(tensor) for tensor in cotangents)
        _launch("soup_activate_backward", len(grads[0]), *saved, *given, *grads)
        return None, *grads, None, None, None, None


def _launch(name: str, triangles: int, *arguments: Tensor | float | None) -> None:
    launch(_PROGRAM, name, blocks(triangles, _THREADS), _THREADS, (ctypes.c_int(triangles), *arguments))
