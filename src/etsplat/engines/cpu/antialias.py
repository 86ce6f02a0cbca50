"""The CPU engine's side of `rasterize_antialiased`: csrc/cpu/antialias.cpp, one view after the other."""

from typing import Any

from torch import Tensor

from etsplat import _native
from etsplat.core.connectivity import MeshConnectivity
from etsplat.engines.native.operation import differentiable
from etsplat.engines.native.pool import empty_image, zeros_image


def _forward(_keep: bool, *given: Any) -> tuple[Tensor, Any]:
    """Shading and blending of what the z-buffer has found."""
    colors, triangle = given[1], given[5]
    shape = *triangle.shape, colors.shape[1]
    shaded, image = empty_image(*shape), empty_image(*shape)
    states = [
        _native.antialias_forward(_input(b, *given), shaded[b].data_ptr(), image[b].data_ptr())
        for b in range(len(image))
    ]
    return image, (*given, shaded, states)


def _backward(kept: Any, needed: Any, grad_image: Tensor) -> list[Tensor | None]:
    """By vertices, colours and backgrounds."""
    *given, shaded, states = kept
    grads = [zeros_image(*tensor.shape) if wanted else None for tensor, wanted in zip(given[:3], needed, strict=False)]
    scratch = empty_image(*shaded.shape[1:])
    for b, state in enumerate(states):
        _native.antialias_backward(
            state,
            _input(b, *given),
            grad_image[b].data_ptr(),
            shaded[b].data_ptr(),
            scratch.data_ptr(),
            *(0 if grad is None else grad.data_ptr() for grad in grads[:2]),
            0 if grads[2] is None else grads[2][b].data_ptr(),
        )
    return grads


def _input(
    b: int,
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
) -> Any:
    """View b, where its arrays lie now."""
    height, width = triangle.shape[1:]
    return _native.AntialiasInput(
        vertices.data_ptr(),
        connectivity.faces.data_ptr(),
        len(vertices),
        len(connectivity.faces),
        viewmats[b].data_ptr(),
        Ks[b].data_ptr(),
        near_plane,
        width,
        height,
        connectivity.pair_offsets.data_ptr(),
        connectivity.paired_faces.data_ptr(),
        *(tensor[b].data_ptr() for tensor in (triangle, barycentrics, depth)),
        colors.data_ptr() if per_face else 0,
        0 if per_face else colors.data_ptr(),
        colors.shape[1],
        backgrounds[b].data_ptr(),
    )


antialias = differentiable(_forward, _backward)
