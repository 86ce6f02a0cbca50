"""The CPU engine's side of `soup_activation`: csrc/cpu/bind_soup_activation.cpp."""

from typing import Any

from torch import Tensor

from etsplat import _native
from etsplat.core.cameras import Cameras
from etsplat.core.validation import dense
from etsplat.engines.native.operation import differentiable
from etsplat.engines.native.pool import empty_image


def _forward(
    _keep: bool,
    vertices: Tensor,
    logits: Tensor,
    raw: Tensor,
    limits: tuple[float, float] | Tensor,
    camera: Cameras | None,
    smallest: float,
    largest: float,
) -> tuple[tuple[Tensor, Tensor], Any]:
    view = () if camera is None else (dense(camera.viewmats, "viewmats"), dense(camera.Ks, "Ks"))
    addresses = [tensor.data_ptr() for tensor in (vertices, logits, raw, *view)] + [0] * (2 - len(view))
    opacities, sigma = empty_image(len(logits)), empty_image(len(logits))
    outputs = opacities.data_ptr(), sigma.data_ptr()
    _native.soup_activate(len(logits), *addresses, smallest, largest, *limits, *outputs)
    return (opacities, sigma), (logits, raw, opacities, limits)


def _backward(kept: Any, _needed: Any, *cotangents: Tensor | None) -> tuple[None, Tensor, Tensor]:
    *saved, limits = kept
    grads = empty_image(len(saved[0])), empty_image(len(saved[0]))
    addresses = (0 if tensor is None else tensor.data_ptr() for tensor in (*cotangents, *grads))
    _native.soup_activate_backward(len(grads[0]), *(tensor.data_ptr() for tensor in saved), *limits, *addresses)
    return None, *grads


soup_activation = differentiable(_forward, _backward)
