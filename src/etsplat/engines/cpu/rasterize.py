"""The rasterizer's calls of csrc/cpu/bind_rasterize.cpp."""

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
    # threads of torch that have gathered would spin for the next milliseconds, where those of the engine are to project
    corners = empty_image(*geometry.faces.shape, values.shape[1])
    _native.gather_rows(values=values, indices=geometry.faces, rows=corners)
    return corners, (geometry, values.shape)


def _scatter(kept: Any, _needed: Any, grad_corners: Tensor) -> tuple[Tensor]:
    geometry, shape = kept
    sums = empty_image(*shape)
    _native.sum_by_index(values=grad_corners, indices=geometry.faces, sums=sums)
    return (sums,)


_per_corner = differentiable(_gather, _scatter)


class CpuRender:
    """One forward pass: a native state for each view."""

    most_channels: int | None = None
    per_corner = staticmethod(_per_corner)

    def __init__(self, plan: Plan, inputs: Inputs, outputs: Outputs, keep: bool) -> None:
        self.plan = plan
        statistics = outputs.statistics
        self.states = _native.raster_forward(
            batch=_batch(inputs, outputs.images, plan),
            keep_for_backward=keep,
            median_triangle=outputs.median_triangle,
            max_weight=statistics and statistics.max_weight,
            screen_size=statistics and statistics.screen_size,
            inradius=statistics and statistics.inradius,
            visible=statistics and statistics.visible,
        )

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
        gradients = _native.RasterGradients(
            grad_color=grad_color,
            grad_alpha=grad_alpha,
            grad_distortion=grad_distortion,
            vertices=grads.vertices,
            flat_colors=grads.flat,
            corner_colors=grads.corner,
            opacities=grads.opacities,
            sigmas=grads.sigma,
            viewmats=grads.viewmats,
            Ks=grads.Ks,
            backgrounds=grads.backgrounds,
        )
        _native.raster_backward(states=self.states, batch=_batch(inputs, images, self.plan), gradients=gradients)
        return grads


def _batch(inputs: Inputs, images: Images, plan: Plan) -> _native.RasterBatch:
    """With the arrays where they lie now."""
    settings = plan.settings
    kernel = KERNELS[settings.kernel]
    alpha_min, alpha_max, x_max, transmittance_min = settings.cutoffs
    return _native.RasterBatch(
        vertices=inputs.vertices,
        faces=plan.geometry.faces,
        flat_colors=inputs.flat,
        corner_colors=inputs.corner,
        opacities=inputs.opacities,
        sigmas=inputs.sigma,
        viewmats=inputs.viewmats,
        Ks=inputs.Ks,
        backgrounds=inputs.backgrounds,
        kernel_table=None if kernel.table is None else kernel.table.native(inputs.vertices.device),
        kernel=kernel.native_id,
        distance=DISTANCES.index(settings.distance),
        freeze_inradius=settings.freeze_inradius,
        near_plane=settings.near_plane,
        alpha_min=alpha_min,
        alpha_max=alpha_max,
        x_max=x_max,
        transmittance_min=transmittance_min,
        distortion_near=DISTORTION_NEAR,
        distortion_far=DISTORTION_FAR,
        centroid_depth=settings.depth_of == "centroid",
        color=images.color,
        alpha=images.alpha,
        distortion=images.distortion,
        distortion_totals=images.distortion_totals,
    )


def _zeros(tensor: Tensor | None, needed: Any) -> Any:
    return zeros_image(*tensor.shape) if needed and tensor is not None else None
