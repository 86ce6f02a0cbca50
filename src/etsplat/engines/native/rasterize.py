"""The native engines' side of ``rasterize``: one autograd function around an engine's ``Render``."""

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from etsplat.core.rasterization import Rasterization, RasterizeSettings, RasterizeTensors
from etsplat.engines.engine import Engine
from etsplat.engines.native.channels import Channels, median_depth
from etsplat.engines.native.operation import differentiable
from etsplat.engines.native.plan import Geometry, Images, Inputs, Outputs, PerInput, Plan, Render, channel_count


def rasterize_native(
    engine: Engine, render: type[Render], tensors: RasterizeTensors, settings: RasterizeSettings
) -> Rasterization:
    """Render with an engine of native code; see `Engine.rasterize`."""
    geometry = Geometry(tensors.vertices, tensors.faces)
    channels = Channels(tensors, geometry, render)
    channels.add_geometry(tensors, settings, engine)
    backgrounds = channels.pad_backgrounds(tensors.backgrounds)

    def run(part: _Part, part_settings: RasterizeSettings) -> tuple[tuple[Tensor, ...], Plan]:
        t, plan = tensors, Plan(render, part_settings, geometry, len(tensors.viewmats))
        views = t.viewmats, t.Ks, part.backgrounds
        inputs = Inputs(t.vertices, part.flat, part.corner, t.opacities, t.sigma, *views)
        return _rasterize(plan, *inputs), plan

    first, *rest = _parts(channels.flat, channels.corner, backgrounds, render.most_channels)
    (color, alpha, distortion, median_triangle), plan = run(first, settings)
    if rest:
        plain = replace(settings, outputs=settings.outputs - {"statistics", "distortion", "median_depth"})
        color = torch.cat([color, *(run(part, plain)[0][0] for part in rest)], dim=-1)
    result = Rasterization(color=color, alpha=alpha, statistics=plan.statistics)
    if settings.wants("distortion"):
        result.distortion = distortion
    if settings.wants("median_depth"):
        result.median_depth = median_depth(median_triangle, channels, tensors, engine)
    channels.split(result)
    return result


@dataclass
class _Part:
    """Channels of one pass."""

    flat: Tensor | None
    corner: Tensor | None
    backgrounds: Tensor | None


def _parts(flat: Tensor | None, corner: Tensor | None, backgrounds: Tensor | None, most: int | None) -> list[_Part]:
    """All channels, or, where they are more than ``most``, parts that lie next to each other in the image."""
    if most is None or channel_count(flat) + channel_count(corner) <= most:
        return [_Part(flat, corner, backgrounds)]
    # A triangle with any channel that is not finite is to be left out of every part.
    finite = torch.ones((), dtype=torch.bool, device=(flat if flat is not None else corner).device)  # type: ignore[union-attr]
    for channels, dims in ((flat, -1), (corner, (-2, -1))):
        finite = finite if channels is None else finite & channels.isfinite().all(dim=dims)
    parts, at = [], 0
    for channels, mask in ((flat, finite[..., None]), (corner, finite[..., None, None])):
        for begin in range(0, channel_count(channels), most):
            chosen = torch.where(mask, channels[..., begin : begin + most], torch.nan)  # type: ignore[index]
            behind = None if backgrounds is None else backgrounds[:, at : at + chosen.shape[-1]]
            parts.append(_Part(chosen, None, behind) if channels is flat else _Part(None, chosen, behind))
            at += chosen.shape[-1]
    return parts


def _forward(keep: bool, plan: Plan, *given: Tensor) -> tuple[tuple[Tensor, ...], Any]:
    """(colour of all channels, alpha, distortion, median triangle); the latter two are empty unless asked for."""
    inputs = Inputs(*given)
    outputs = Outputs(plan, inputs)
    render = plan.render(plan, inputs, outputs, keep)
    plan.statistics, images = outputs.statistics, outputs.images
    shown = images.color, images.alpha, images.distortion, outputs.median_triangle
    return shown, (render, *inputs, *images)


def _backward(kept: Any, needed: Any, *cotangents: Tensor | None) -> tuple[Tensor | None, ...]:
    render, *saved = kept
    count = len(Inputs._fields)
    inputs, images = Inputs(*saved[:count]), Images(*saved[count:])
    return None, *render.backward(inputs, images, cotangents[:3], PerInput(*needed[1:]))


_rasterize = differentiable(_forward, _backward)
