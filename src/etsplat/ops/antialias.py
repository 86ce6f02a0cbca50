"""Differentiable z-buffer rasterization of a mesh with antialiased silhouettes (Laine et al. 2020).

A pixel shows the nearest triangle at its centre, in the colour of the face or interpolated between its vertices with
perspective-correct barycentrics. That image is a step function of the vertices, so silhouettes are blended: where two
neighbouring pixels see different triangles, and a silhouette edge of the nearer one crosses the segment between their
centres at the fraction d, seen from its own pixel, then

    d < 1/2:  the own pixel gets (1/2 - d) (other colour - own colour)
    d > 1/2:  the other pixel gets (d - 1/2) (own colour - other colour)

An edge is a silhouette if no face across it lies on its other side of the screen (or none at all), and it counts for
a horizontal pair if it is at least as steep as the diagonal, for a vertical pair if at most. d moves with the two ends
of the edge: that is where vertices get gradients from; vertex colours give them more through the barycentrics. Edges
within the surface give none, so the mesh must be welded. A triangle too small to own a pixel has no silhouette.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat import _native
from etsplat.core.validation import check_device, check_intrinsics, check_like, check_shape, dense
from etsplat.ops._antialias_cuda import AntialiasCuda
from etsplat.ops._antialias_reference import antialias_reference
from etsplat.ops.engines import resolve_engine
from etsplat.ops.mesh_energies import MeshConnectivity
from etsplat.ops.pool import empty_image, zeros_image
from etsplat.ops.rasterize_hard import HardRasterization, rasterize_hard


def rasterize_antialiased(
    vertices: Float[Tensor, "V 3"],
    connectivity: MeshConnectivity,
    viewmats: Float[Tensor, "B 4 4"],
    Ks: Float[Tensor, "B 3 3"],
    width: int,
    height: int,
    *,
    face_colors: Float[Tensor, "F C"] | None = None,
    vertex_colors: Float[Tensor, "V C"] | None = None,
    backgrounds: Float[Tensor, "B C"] | None = None,
    near_plane: float = 0.01,
    engine: str | None = None,
) -> Float[Tensor, "B H W C"]:
    """Picture of an opaque mesh, differentiable by vertices, colours and backgrounds.

    Args:
        vertices: (V, 3) of a welded mesh, world space.
        connectivity: its faces and which of them share edges; ``MeshTopology.connectivity``.
        viewmats: (B, 4, 4) world to camera, OpenCV axes.
        Ks: (B, 3, 3) intrinsics [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels.
        width: Image width in pixels.
        height: Image height in pixels.
        face_colors: (F, C), one colour per face. Exactly one of the two colours is given.
        vertex_colors: (V, C), interpolated perspective-correctly.
        backgrounds: (B, C); None is black.
        near_plane: Triangles with a vertex at this depth or nearer are dropped; > 0.
        engine: "cpu", "cuda", "reference" or None (by dtype and device).

    Returns:
        (B, H, W, C). The native engines' images and gradients are the same bits in every run.

    Raises:
        ValueError: Wrong shape, dtype or device; the message names the argument.
    """
    colors = _check(vertices, connectivity, viewmats, Ks, face_colors, vertex_colors)
    if backgrounds is None:
        backgrounds = vertices.new_zeros(len(viewmats), colors.shape[1])
    check_shape("backgrounds", backgrounds, (len(viewmats), colors.shape[1]))
    check_like("backgrounds", backgrounds, "vertices", vertices)
    seen = rasterize_hard(
        vertices, viewmats, Ks, width, height, faces=connectivity.faces, near_plane=near_plane, engine=engine
    )
    per_face = face_colors is not None
    chosen = resolve_engine(engine, vertices)
    if chosen != "reference":
        native = AntialiasCuda if chosen == "cuda" else _Antialias
        view = (dense(viewmats, "viewmats"), dense(Ks, "Ks"), near_plane, width, height)
        image: Any = native.apply(vertices, colors, backgrounds, per_face, connectivity, view, seen)
        return image
    images = [
        antialias_reference(
            vertices,
            connectivity,
            viewmats[b].detach(),
            Ks[b].detach(),
            near_plane,
            colors,
            per_face,
            backgrounds[b],
            seen.triangle[b],
            seen.depth[b],
        )
        for b in range(len(viewmats))
    ]
    return torch.stack(images) if images else vertices.new_zeros(0, height, width, colors.shape[1])


def _check(
    vertices: Tensor,
    connectivity: MeshConnectivity,
    viewmats: Tensor,
    Ks: Tensor,
    face_colors: Tensor | None,
    vertex_colors: Tensor | None,
) -> Tensor:
    """Checks what ``rasterize_hard`` does not; returns the colours."""
    check_shape("vertices", vertices, (connectivity.num_vertices, 3))
    check_device("connectivity", connectivity.faces, "vertices", vertices)
    check_shape("viewmats", viewmats, ("B", 4, 4))
    check_shape("Ks", Ks, (len(viewmats), 3, 3))
    if Ks.device.type == "cpu":  # reading them would wait for a GPU
        check_intrinsics("Ks", Ks)
    if (face_colors is None) == (vertex_colors is None):
        raise ValueError("exactly one of face_colors and vertex_colors must be given")
    for name, colors, count in (
        ("face_colors", face_colors, len(connectivity.faces)),
        ("vertex_colors", vertex_colors, len(vertices)),
    ):
        if colors is not None:
            check_shape(name, colors, (count, "C"))
            check_like(name, colors, "vertices", vertices)
            return colors
    raise AssertionError


class _Antialias(torch.autograd.Function):
    """Shading and blending of what the z-buffer has found."""

    @staticmethod
    def forward(
        ctx: Any,
        vertices: Tensor,
        colors: Tensor,
        backgrounds: Tensor,
        per_face: bool,
        connectivity: MeshConnectivity,
        view: tuple[Tensor, Tensor, float, int, int],
        seen: HardRasterization,
    ) -> Tensor:
        inputs = dense(vertices), dense(colors), dense(backgrounds), *view[:2]
        shape = len(view[0]), view[4], view[3], colors.shape[1]
        shaded, image = empty_image(*shape), empty_image(*shape)
        ctx.per_face, ctx.connectivity, ctx.sizes = per_face, connectivity, view[2:]
        found = seen.triangle, seen.barycentrics, seen.depth
        ctx.states = [
            _native.antialias_forward(_input(b, inputs, found, ctx), shaded[b].data_ptr(), image[b].data_ptr())
            for b in range(len(image))
        ]
        ctx.save_for_backward(*inputs, *found, shaded)
        return image

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad_image: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        *saved, shaded = map(dense, ctx.saved_tensors)
        inputs, found = tuple(saved[:5]), tuple(saved[5:])
        grad_image = dense(grad_image)
        grads = [
            zeros_image(*tensor.shape) if needed else None
            for tensor, needed in zip(inputs[:3], ctx.needs_input_grad, strict=False)
        ]
        scratch = empty_image(*shaded.shape[1:])
        for b, state in enumerate(ctx.states):
            _native.antialias_backward(
                state,
                _input(b, inputs, found, ctx),
                grad_image[b].data_ptr(),
                shaded[b].data_ptr(),
                scratch.data_ptr(),
                *(0 if grad is None else grad.data_ptr() for grad in grads[:2]),
                0 if grads[2] is None else grads[2][b].data_ptr(),
            )
        return (*grads, None, None, None, None)


def _input(b: int, inputs: tuple[Tensor, ...], found: tuple[Tensor, ...], ctx: Any) -> Any:
    """View b, where its arrays lie now."""
    vertices, colors, backgrounds, viewmats, Ks = inputs
    connectivity, (near_plane, width, height) = ctx.connectivity, ctx.sizes
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
        *(tensor[b].data_ptr() for tensor in found),
        colors.data_ptr() if ctx.per_face else 0,
        0 if ctx.per_face else colors.data_ptr(),
        colors.shape[1],
        backgrounds[b].data_ptr(),
    )
