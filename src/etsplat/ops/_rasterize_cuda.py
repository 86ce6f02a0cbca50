"""The GPU engine's side of ``rasterize``: one autograd function around the launches of _raster_render_cuda.py."""

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from etsplat.core.rasterization import Rasterization, RasterizeSettings
from etsplat.cuda.launch import on_device_of
from etsplat.ops._raster_render_cuda import Geometry, Outputs, Plan, Render, channel_count, contiguous
from etsplat.ops._rasterize_channels import Channels, corners_of, median_depth

MOST_CHANNELS = 16  # of one pass; more are rendered in several


def rasterize_cuda(
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
    """Render on the GPU; arguments as ``etsplat.rasterize`` has checked them."""
    channels = Channels(colors, corner_colors, faces)
    if settings.depth != "none" or settings.normals:
        channels.add_geometry(corners_of(vertices, faces), viewmats, settings, "cuda")
    backgrounds = channels.pad_backgrounds(backgrounds)
    geometry = Geometry(vertices, faces)

    def run(part: _Part, part_settings: RasterizeSettings) -> tuple[tuple[Tensor, ...], Plan]:
        plan = Plan(part_settings, geometry, viewmats.shape[0])
        inputs = (vertices, part.flat, part.corner, opacities, sigma, viewmats, Ks, part.backgrounds)
        return _Rasterize.apply(*inputs, plan), plan

    first, *rest = _parts(channels.flat, channels.corner, backgrounds)
    (color, alpha, distortion, median_triangle), plan = run(first, settings)
    if rest:
        plain = replace(settings, statistics=False, distortion=False, median_depth=False)
        color = torch.cat([color, *(run(part, plain)[0][0] for part in rest)], dim=-1)
    result = Rasterization(color=color, alpha=alpha, statistics=plan.statistics)
    if settings.distortion:
        result.distortion = distortion
    if settings.median_depth:
        corners = corners_of(vertices, faces)
        result.median_depth = median_depth(median_triangle, channels, corners, viewmats, Ks, "cuda")
    channels.split(result)
    return result


@dataclass
class _Part:
    """Channels of one pass."""

    flat: Tensor | None
    corner: Tensor | None
    backgrounds: Tensor | None


def _parts(flat: Tensor | None, corner: Tensor | None, backgrounds: Tensor | None) -> list[_Part]:
    """All channels, or, where they are too many, parts of them that lie next to each other in the image."""
    sizes = [0 if t is None else t.shape[-1] for t in (flat, corner)]
    if sum(sizes) <= MOST_CHANNELS:
        return [_Part(flat, corner, backgrounds)]
    # A triangle with any channel that is not finite is to be left out of every part.
    finite = torch.ones((), dtype=torch.bool, device=(flat if flat is not None else corner).device)  # type: ignore[union-attr]
    for channels, dims in ((flat, -1), (corner, (-2, -1))):
        finite = finite if channels is None else finite & channels.isfinite().all(dim=dims)
    parts, at = [], 0
    for channels, mask in ((flat, finite[..., None]), (corner, finite[..., None, None])):
        for begin in range(0, channel_count(channels), MOST_CHANNELS):
            chosen = torch.where(mask, channels[..., begin : begin + MOST_CHANNELS], torch.nan)  # type: ignore[index]
            behind = None if backgrounds is None else backgrounds[:, at : at + chosen.shape[-1]]
            parts.append(_Part(chosen, None, behind) if channels is flat else _Part(None, chosen, behind))
            at += chosen.shape[-1]
    return parts


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
        plan: Plan,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        inputs = [contiguous(t) for t in (vertices, flat, corner, opacities, sigma, viewmats, Ks, backgrounds)]
        outputs = Outputs(plan, inputs)
        ctx.render = Render(plan, inputs, outputs, keep=any(ctx.needs_input_grad))
        with on_device_of(vertices):
            ctx.render.forward()
        plan.statistics = outputs.statistics
        ctx.save_for_backward(*inputs, outputs.color, outputs.alpha, outputs.distortion)
        ctx.mark_non_differentiable(outputs.median_triangle)
        ctx.set_materialize_grads(False)
        return outputs.color, outputs.alpha, outputs.distortion, outputs.median_triangle

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride] -- once_differentiable hides the name
        ctx: Any, *cotangents: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        *inputs, _, _, _ = ctx.saved_tensors
        with on_device_of(inputs[0]):
            grads = ctx.render.backward(inputs, [contiguous(g) for g in cotangents[:3]], ctx.needs_input_grad)
        return (*grads, None)
