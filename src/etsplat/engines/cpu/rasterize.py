"""The rasterizer's calls of csrc/cpu/raster.cpp: one for each view of a batch."""

from typing import Any

from torch import Tensor

from etsplat import _native
from etsplat.core.kernels import DISTANCES, KERNELS
from etsplat.core.rasterization import DISTORTION_FAR, DISTORTION_NEAR
from etsplat.engines.native.operation import differentiable
from etsplat.engines.native.plan import Geometry, Images, Inputs, Outputs, PerInput, Plan
from etsplat.engines.native.pool import empty_image, zeros_image


def _gather(_keep: bool, values: Tensor, _faces: Tensor, geometry: Geometry) -> tuple[Tensor, Any]:
    """(V, C) -> (N, 3, C). Autograd's own backward of the indexing takes longer than rasterizing."""
    assert geometry.faces is not None
    # values[faces] takes five times as long
    return values.index_select(0, geometry.faces.view(-1)).view(-1, 3, values.shape[1]), (geometry, values.shape)


def _scatter(kept: Any, _needed: Any, grad_corners: Tensor) -> tuple[Tensor]:
    geometry, shape = kept
    sums = empty_image(*shape)
    arrays = (grad_corners, *geometry.corners)
    _native.sum_groups(*(array.data_ptr() for array in arrays), *shape, sums.data_ptr())
    return (sums,)


_per_corner = differentiable(_gather, _scatter)


class CpuRender:
    """One forward pass: a native state for each view."""

    most_channels: int | None = None
    per_corner = staticmethod(_per_corner)

    def __init__(self, plan: Plan, inputs: Inputs, outputs: Outputs, keep: bool) -> None:
        self.plan = plan
        self.states = []
        for b in range(plan.views):
            call = _call(b, inputs, outputs.images, plan)
            call.keep_for_backward = keep
            if plan.settings.wants("median_depth"):
                call.median_triangle = _address(outputs.median_triangle, b)
            if outputs.statistics is not None:
                call.max_weight = _address(outputs.statistics.max_weight, b)
                call.screen_size = _address(outputs.statistics.screen_size, b)
                call.inradius = _address(outputs.statistics.inradius, b)
                call.visible = _address(outputs.statistics.visible, b)
            self.states.append(_native.raster_forward(call))

    def backward(
        self,
        inputs: Inputs,
        images: Images,
        cotangents: tuple[Tensor | None, Tensor | None, Tensor | None],
        needed: PerInput,
    ) -> PerInput:
        """See ``Render``."""
        grad_color, grad_alpha, grad_distortion = cotangents
        if grad_color is None:
            grad_color = zeros_image(*images.color.shape)
        grads = PerInput(*map(_zeros, inputs, needed))
        for b, state in enumerate(self.states):
            call = _native.RasterGradients()
            call.grad_color = _address(grad_color, b)
            call.grad_alpha = _address(grad_alpha, b)
            call.grad_distortion = _address(grad_distortion, b)
            if needed.vertices and self.plan.geometry.faces is not None:
                call.corner_offsets, call.corner_indices = map(_address, self.plan.geometry.corners)
            call.vertices = _address(grads.vertices)
            call.flat_colors = _address(grads.flat, b if inputs.flat_per_view else None)
            call.corner_colors = _address(grads.corner, b if inputs.corner_per_view else None)
            call.opacities = _address(grads.opacities)
            call.sigmas = _address(grads.sigma)
            call.viewmat = _address(grads.viewmats, b)
            call.K = _address(grads.Ks, b)
            call.background = _address(grads.backgrounds, b)
            _native.raster_backward(state, _call(b, inputs, images, self.plan), call)
        return grads


def _call(b: int, inputs: Inputs, images: Images, plan: Plan) -> Any:
    settings, geometry = plan.settings, plan.geometry
    call = _native.RasterCall()
    call.vertices = _address(inputs.vertices)
    call.faces = _address(geometry.faces)
    call.num_triangles = geometry.count
    call.num_vertices = geometry.vertex_count
    call.flat_colors = _address(inputs.flat, b if inputs.flat_per_view else None)
    call.corner_colors = _address(inputs.corner, b if inputs.corner_per_view else None)
    call.flat_channels, call.corner_channels = inputs.channels
    call.opacities = _address(inputs.opacities)
    call.sigmas = _address(inputs.sigma)
    call.shared_sigma = inputs.sigma.dim() == 0
    call.viewmat = _address(inputs.viewmats, b)
    call.K = _address(inputs.Ks, b)
    call.background = _address(inputs.backgrounds, b)
    call.width = settings.width
    call.height = settings.height
    kernel = KERNELS[settings.kernel]
    call.kernel = kernel.native_id
    if kernel.table is not None:
        call.kernel_table = _address(kernel.table.native(inputs.vertices.device))
    call.distance = DISTANCES.index(settings.distance)
    call.freeze_inradius = settings.freeze_inradius
    call.near_plane = settings.near_plane
    call.alpha_min, call.alpha_max, call.x_max, call.transmittance_min = settings.cutoffs
    call.distortion_near = DISTORTION_NEAR
    call.distortion_far = DISTORTION_FAR
    call.centroid_depth = settings.depth_of == "centroid"
    call.color = _address(images.color, b)
    call.alpha = _address(images.alpha, b)
    if settings.wants("distortion"):
        call.distortion = _address(images.distortion, b)
        call.distortion_totals = _address(images.distortion_totals, b)
    return call


def _zeros(tensor: Tensor | None, needed: Any) -> Any:
    return zeros_image(*tensor.shape) if needed and tensor is not None else None


def _address(tensor: Tensor | None, index: int | None = None) -> int:
    """Address of a contiguous tensor, or of its ``index``-th row; 0 for None."""
    if tensor is None:
        return 0
    if index is None:
        return tensor.data_ptr()
    return tensor.data_ptr() + index * tensor.stride(0) * tensor.element_size()
