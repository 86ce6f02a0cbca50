"""From the parameters of a soup to the opacities and the softness that are drawn.

    o = floor + (1 - floor) / (1 + exp(-logit))      sigma = min(0.01 + exp(raw), ceiling)

With a camera, o = 0 for triangles that are too small or too large there, as Triangle Splatting has it.
"""

import ctypes
import math
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from etsplat import _native
from etsplat.core.cameras import Cameras
from etsplat.core.validation import check_like, check_shape, dense
from etsplat.cuda.launch import blocks, launch
from etsplat.cuda.program import Program
from etsplat.cuda.transfer import upload
from etsplat.ops.engines import resolve_engine
from etsplat.ops.pool import empty_image

SOUP_SIGMA_FLOOR = 0.01
"""No triangle of a soup gets sharper than this."""

Limits = tuple[float, float] | Float[Tensor, "2"]
_PROGRAM = Program("soup_activation.cu")
_THREADS = 256


def soup_activation(
    vertices: Float[Tensor, "N 3 3"],
    opacity_logits: Float[Tensor, " N"],
    sigma_raw: Float[Tensor, " N"],
    limits: Limits,
    camera: Cameras | None = None,
    *,
    smallest: float = 0.0,
    largest: float = math.inf,
    engine: str | None = None,
) -> tuple[Float[Tensor, " N"], Float[Tensor, " N"]]:
    """Opacities and sigma as they are drawn, differentiable with respect to the logits and ``sigma_raw``.

    Args:
        vertices: (N, 3, 3) corners in world space; only looked at for ``camera``.
        opacity_logits: (N,).
        sigma_raw: (N,).
        limits: Opacity floor in [0, 1) and sigma ceiling, which may be infinite; for engine "cuda" also as a tensor.
        camera: One camera, for whose image triangles are left out by their size; None keeps them.
        smallest: In pixels: triangles with a smaller inradius are left out.
        largest: In pixels: so are those where a vertex is farther from the mean of the projected vertices.
        engine: "cpu", "cuda", "reference" or None (by dtype and device).

    Returns:
        (N,) opacities, 0 for those that are left out, and (N,) sigma.

    Raises:
        ValueError: Wrong shape, dtype or device; more than one camera.
    """
    N = len(vertices)
    check_shape("vertices", vertices, ("N", 3, 3))
    for name, tensor in (("opacity_logits", opacity_logits), ("sigma_raw", sigma_raw)):
        check_shape(name, tensor, (N,))
        check_like(name, tensor, "vertices", vertices)
    if camera is not None and len(camera) != 1:
        raise ValueError(f"camera must be one where triangles are left out, got {len(camera)}")
    chosen = resolve_engine(engine, vertices)
    if chosen == "reference":
        floor, ceiling = limits
        opacities = floor + (1.0 - floor) * torch.sigmoid(opacity_logits)
        if camera is not None:
            opacities = torch.where(_left_out(vertices.detach(), camera, smallest, largest), 0.0, opacities)
        return opacities, (SOUP_SIGMA_FLOOR + torch.exp(sigma_raw)).clamp_max(ceiling)
    if chosen == "cuda" and not isinstance(limits, Tensor):
        limits = upload(limits, vertices.device)
    view = (None, None) if camera is None else (dense(camera.viewmats, "viewmats"), dense(camera.Ks, "Ks"))
    native = _OnDevice if chosen == "cuda" else _OnCpu
    drawn: Any = native.apply(vertices.detach(), opacity_logits, sigma_raw, *view, (smallest, largest), limits)
    return drawn


def _left_out(vertices: Float[Tensor, "N 3 3"], camera: Cameras, smallest: float, largest: float) -> Bool[Tensor, " N"]:
    """Which triangles have a smaller inradius, 2 area / perimeter, or reach farther from their middle, projected."""
    rotation, translation = camera.viewmats[0, :3, :3], camera.viewmats[0, :3, 3]
    points = vertices @ rotation.T + translation
    pixels = points[..., :2] / points[..., 2:].clamp_min(1e-6) * torch.diagonal(camera.Ks[0])[:2]
    edges = pixels - pixels.roll(1, dims=1)
    doubled = (edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]).abs()
    reach = (pixels - pixels.mean(dim=1, keepdim=True)).norm(dim=-1).amax(dim=-1)
    return (doubled < smallest * edges.norm(dim=-1).sum(dim=-1)) | (reach > largest)


class _OnCpu(torch.autograd.Function):
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


class _OnDevice(torch.autograd.Function):
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
