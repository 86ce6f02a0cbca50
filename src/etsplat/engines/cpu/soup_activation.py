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
    limits: tuple[float, float],
    camera: Cameras | None,
    smallest: float,
    largest: float,
) -> tuple[tuple[Tensor, Tensor], Any]:
    opacities, sigma = empty_image(len(logits)), empty_image(len(logits))
    _native.soup_activate(
        vertices=vertices,
        logits=logits,
        raw=raw,
        viewmats=None if camera is None else dense(camera.viewmats, "viewmats"),
        Ks=None if camera is None else dense(camera.Ks, "Ks"),
        smallest=smallest,
        largest=largest,
        opacity_floor=limits[0],
        sigma_ceiling=limits[1],
        opacities=opacities,
        sigma=sigma,
    )
    return (opacities, sigma), (logits, raw, opacities, limits)


def _backward(
    kept: Any, _needed: Any, grad_opacities: Tensor | None, grad_sigma: Tensor | None
) -> tuple[None, Tensor, Tensor]:
    logits, raw, opacities, limits = kept
    grad_logits, grad_raw = empty_image(len(logits)), empty_image(len(raw))
    _native.soup_activate_backward(
        logits=logits,
        raw=raw,
        opacities=opacities,
        opacity_floor=limits[0],
        sigma_ceiling=limits[1],
        grad_opacities=grad_opacities,
        grad_sigma=grad_sigma,
        grad_logits=grad_logits,
        grad_raw=grad_raw,
    )
    return None, grad_logits, grad_raw


soup_activation = differentiable(_forward, _backward)
