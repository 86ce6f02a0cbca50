"""The CPU engine's side of `rasterize_antialiased`: csrc/cpu/antialias.cpp, one view after the other."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from etsplat import _native
from etsplat.core.connectivity import MeshConnectivity
from etsplat.core.validation import dense
from etsplat.engines.native.pool import empty_image, zeros_image


class Antialias(torch.autograd.Function):
    """Shading and blending of what the z-buffer has found."""

    @staticmethod
    def forward(
        ctx: Any,
        vertices: Tensor,
        colors: Tensor,
        backgrounds: Tensor,
        viewmats: Tensor,
        Ks: Tensor,
        triangle: Tensor,
        barycentrics: Tensor,
        depth: Tensor,
        near_plane: float,
        per_face: bool,
        connectivity: MeshConnectivity,
    ) -> Tensor:
        """See `Engine.antialias`."""
        found = triangle, barycentrics, depth
        inputs = [dense(tensor) for tensor in (vertices, colors, backgrounds, viewmats, Ks, *found)]
        shape = *triangle.shape, colors.shape[1]
        shaded, image = empty_image(*shape), empty_image(*shape)
        ctx.near_plane, ctx.per_face, ctx.connectivity = near_plane, per_face, connectivity
        ctx.states = [
            _native.antialias_forward(_input(b, inputs, ctx), shaded[b].data_ptr(), image[b].data_ptr())
            for b in range(len(image))
        ]
        ctx.save_for_backward(*inputs, shaded)
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """By vertices, colours and backgrounds."""
        *inputs, shaded = map(dense, ctx.saved_tensors)
        grad_image = dense(grad_image)
        grads = [
            zeros_image(*tensor.shape) if needed else None
            for tensor, needed in zip(inputs[:3], ctx.needs_input_grad, strict=False)
        ]
        scratch = empty_image(*shaded.shape[1:])
        for b, state in enumerate(ctx.states):
            _native.antialias_backward(
                state,
                _input(b, inputs, ctx),
                grad_image[b].data_ptr(),
                shaded[b].data_ptr(),
                scratch.data_ptr(),
                *(0 if grad is None else grad.data_ptr() for grad in grads[:2]),
                0 if grads[2] is None else grads[2][b].data_ptr(),
            )
        return *grads, *(None,) * 8


def _input(b: int, inputs: list[Tensor], ctx: Any) -> Any:
    """View b, where its arrays lie now."""
    vertices, colors, backgrounds, viewmats, Ks, *found = inputs
    connectivity, (height, width) = ctx.connectivity, found[0].shape[1:]
    return _native.AntialiasInput(
        vertices.data_ptr(),
        connectivity.faces.data_ptr(),
        len(vertices),
        len(connectivity.faces),
        viewmats[b].data_ptr(),
        Ks[b].data_ptr(),
        ctx.near_plane,
        width,
        height,
        connectivity.pair_offsets.data_ptr(),
        connectivity.paired_faces.data_ptr(),
        *(tensor[b].data_ptr() for tensor in found),
        colors.data_ptr() if ctx.per_face else 0,
        0 if ctx.per_face else colors.data_ptr(),
        colors.shape[1],
        backgrounds[b].data_ptr(),
    )
