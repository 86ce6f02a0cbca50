"""The native engine's side of ``rasterize``: one autograd function around csrc/cpu/raster.cpp."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from etsplat import _native
from etsplat.core.kernels import DISTANCES, KERNELS
from etsplat.core.rasterization import (
    DISTORTION_FAR,
    DISTORTION_NEAR,
    Rasterization,
    RasterizeSettings,
    TriangleStatistics,
)
from etsplat.ops._rasterize_channels import Channels, corners_of, median_depth
from etsplat.ops.pool import empty_image, zeros_like


def rasterize_cpu(
    vertices: Tensor,
    faces: Tensor | None,
    colors: Tensor | None,
    corner_colors: Tensor | None,
    opacities: Tensor,
    sigma: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    backgrounds: Tensor | None,
    settings: RasterizeSettings,
) -> Rasterization:
    """Render with the native engine; arguments as ``etsplat.rasterize`` has checked them."""
    mesh = _Mesh(vertices, faces)
    if corner_colors is not None and corner_colors.dim() == 2:
        corner_colors = _PerCorner.apply(corner_colors, mesh)
    channels = Channels(colors, corner_colors, faces)
    if settings.depth != "none" or settings.normals:
        channels.add_geometry(corners_of(vertices, faces), viewmats, settings, "cpu")
    backgrounds = channels.pad_backgrounds(backgrounds)
    plan = _Plan(settings, mesh, channels.flat_per_view)
    color, alpha, distortion, median_triangle = _Rasterize.apply(
        vertices, channels.flat, channels.corner, opacities, sigma, viewmats, Ks, backgrounds, plan
    )
    result = Rasterization(color=color, alpha=alpha, statistics=plan.statistics)
    if settings.distortion:
        result.distortion = distortion
    if settings.median_depth:
        corners = corners_of(vertices, faces)
        result.median_depth = median_depth(median_triangle, channels, corners, viewmats, Ks, "cpu")
    channels.split(result)
    return result


class _PerCorner(torch.autograd.Function):
    """(V, C) -> (N, 3, C). Autograd's own backward of the indexing takes longer than rasterizing."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, mesh: "_Mesh") -> Tensor:
        ctx.mesh, ctx.shape = mesh, values.shape
        assert mesh.faces32 is not None
        # values[faces32] takes five times as long
        return values.index_select(0, mesh.faces32.view(-1)).view(-1, 3, values.shape[1])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_corners: Tensor) -> tuple[Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        sums = empty_image(*ctx.shape)
        _native.sum_groups(
            grad_corners.contiguous().data_ptr(),
            _address(ctx.mesh.corner_offsets),
            _address(ctx.mesh.corner_indices),
            *ctx.shape,
            sums.data_ptr(),
        )
        return sums, None


class _Mesh:
    """Triangles with the index arrays that the native code wants: int32 faces and the corners at each vertex."""

    def __init__(self, vertices: Tensor, faces: Tensor | None) -> None:
        self.count = vertices.shape[0] if faces is None else faces.shape[0]
        self.faces32, self.corner_offsets, self.corner_indices = _face_arrays(faces, vertices.shape[0])


def _face_arrays(faces: Tensor | None, num_vertices: int) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
    """int32 faces, and for each vertex the places 3 face + corner that use it (CSR); kept on the tensor."""
    if faces is None:
        return None, None, None
    key = (faces._version, num_vertices)
    cached = getattr(faces, "_etsplat_face_arrays", None)
    if cached is None or cached[0] != key:
        faces32 = faces.to(torch.int32).contiguous()
        flat = faces32.reshape(-1)
        offsets = torch.zeros(num_vertices + 1, dtype=torch.int32)
        offsets[1:] = torch.bincount(flat, minlength=num_vertices).cumsum(0)
        indices = torch.argsort(flat, stable=True).to(torch.int32)
        cached = (key, faces32, offsets, indices)
        setattr(faces, "_etsplat_face_arrays", cached)  # noqa: B010
    return cached[1], cached[2], cached[3]


@dataclass
class _Plan:
    """What the autograd function needs besides tensors; it leaves the statistics here."""

    settings: RasterizeSettings
    mesh: _Mesh
    flat_per_view: bool
    statistics: TriangleStatistics | None = None


class _Rasterize(torch.autograd.Function):
    """(colour of all channels, alpha, distortion, median triangle); the latter two are empty unless asked for."""

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        vertices: Tensor,
        flat: Tensor | None,
        corner: Tensor | None,
        opacities: Tensor,
        sigma: Tensor,
        viewmats: Tensor,
        Ks: Tensor,
        backgrounds: Tensor | None,
        plan: _Plan,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        inputs = [_contiguous(t) for t in (vertices, flat, corner, opacities, sigma, viewmats, Ks, backgrounds)]
        outputs = _Outputs(plan, viewmats.shape[0], _channel_count(flat) + _channel_count(corner))
        keep = any(ctx.needs_input_grad)
        ctx.states = [
            _native.raster_forward(_native_call(b, inputs, outputs, plan, keep)) for b in range(viewmats.shape[0])
        ]
        plan.statistics = outputs.statistics
        ctx.plan = plan
        # The native state refers to these by address, so they must live as long as it does.
        ctx.totals = outputs.distortion_totals
        ctx.save_for_backward(*inputs, outputs.color, outputs.alpha, outputs.distortion)
        ctx.mark_non_differentiable(outputs.median_triangle)
        ctx.set_materialize_grads(False)
        return outputs.color, outputs.alpha, outputs.distortion, outputs.median_triangle

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride] -- once_differentiable hides the name
        ctx: Any, *cotangents: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        *inputs, color, _, _ = ctx.saved_tensors
        grad_color, grad_alpha, grad_distortion = (_contiguous(g) for g in cotangents[:3])
        if grad_color is None:
            grad_color = zeros_like(color)
        mesh = ctx.plan.mesh
        grads = [
            zeros_like(t) if needed and t is not None else None
            for t, needed in zip(inputs, ctx.needs_input_grad, strict=False)
        ]
        grads[6] = None  # Ks are not differentiated
        for b, state in enumerate(ctx.states):
            call = _native.RasterGradients()
            call.grad_color = _address(grad_color, b)
            call.grad_alpha = _address(grad_alpha, b)
            call.grad_distortion = _address(grad_distortion, b)
            call.corner_offsets = _address(mesh.corner_offsets)
            call.corner_indices = _address(mesh.corner_indices)
            call.vertices = _address(grads[0])
            call.flat_colors = _address(grads[1], b if ctx.plan.flat_per_view else None)
            call.corner_colors = _address(grads[2], b if inputs[2] is not None and inputs[2].dim() == 4 else None)
            call.opacities = _address(grads[3])
            call.sigmas = _address(grads[4])
            call.viewmat = _address(grads[5], b)
            call.background = _address(grads[7], b)
            _native.raster_backward(state, call)
        return (*grads, None)


class _Outputs:
    """Uninitialised output images of a batch; every element is written by the native code."""

    def __init__(self, plan: _Plan, batch: int, channels: int) -> None:
        settings = plan.settings
        image = (batch, settings.height, settings.width)
        self.color = empty_image(*image, channels)
        self.alpha = empty_image(*image, 1)
        self.distortion = empty_image(*image, 1) if settings.distortion else torch.empty(0)
        self.distortion_totals = empty_image(*image, 2) if settings.distortion else None
        self.median_triangle = torch.empty(image if settings.median_depth else 0, dtype=torch.int32)
        self.statistics = None
        if settings.statistics:
            n = (batch, plan.mesh.count)
            self.statistics = TriangleStatistics(
                torch.empty(n), torch.empty(n), torch.empty(n), torch.empty(n, dtype=torch.bool)
            )


def _native_call(b: int, inputs: list[Tensor | None], outputs: _Outputs, plan: _Plan, keep: bool) -> Any:
    vertices, flat, corner, opacities, sigma, viewmats, Ks, backgrounds = inputs
    settings, mesh = plan.settings, plan.mesh
    assert vertices is not None
    assert sigma is not None
    call = _native.RasterCall()
    call.vertices = _address(vertices)
    call.faces = _address(mesh.faces32)
    call.num_triangles = mesh.count
    call.num_vertices = vertices.shape[0]
    call.flat_colors = _address(flat, b if plan.flat_per_view else None)
    call.corner_colors = _address(corner, b if corner is not None and corner.dim() == 4 else None)
    call.flat_channels = _channel_count(flat)
    call.corner_channels = _channel_count(corner)
    call.opacities = _address(opacities)
    call.sigmas = _address(sigma)
    call.shared_sigma = sigma.dim() == 0
    call.viewmat = _address(viewmats, b)
    call.K = _address(Ks, b)
    call.background = _address(backgrounds, b)
    call.width = settings.width
    call.height = settings.height
    call.kernel = list(KERNELS).index(settings.kernel)
    call.distance = DISTANCES.index(settings.distance)
    call.freeze_incentre = settings.freeze_incentre
    call.near_plane = settings.near_plane
    call.alpha_min, call.alpha_max, call.x_max, call.transmittance_min = settings.cutoffs
    call.distortion_near = DISTORTION_NEAR
    call.distortion_far = DISTORTION_FAR
    call.centroid_depth = settings.depth == "centroid"
    call.keep_for_backward = keep
    call.color = _address(outputs.color, b)
    call.alpha = _address(outputs.alpha, b)
    if settings.distortion:
        call.distortion = _address(outputs.distortion, b)
        call.distortion_totals = _address(outputs.distortion_totals, b)
    if settings.median_depth:
        call.median_triangle = _address(outputs.median_triangle, b)
    if outputs.statistics is not None:
        call.max_weight = _address(outputs.statistics.max_weight, b)
        call.screen_size = _address(outputs.statistics.screen_size, b)
        call.inradius = _address(outputs.statistics.inradius, b)
        call.visible = _address(outputs.statistics.visible, b)
    return call


def _contiguous(tensor: Tensor | None) -> Tensor | None:
    return None if tensor is None else tensor.detach().contiguous()


def _channel_count(tensor: Tensor | None) -> int:
    return 0 if tensor is None else tensor.shape[-1]


def _address(tensor: Tensor | None, index: int | None = None) -> int:
    """Address of a contiguous tensor, or of its ``index``-th row; 0 for None."""
    if tensor is None:
        return 0
    if index is None:
        return tensor.data_ptr()
    return tensor.data_ptr() + index * tensor.stride(0) * tensor.element_size()
