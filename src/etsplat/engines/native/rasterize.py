"""The native engines' side of ``rasterize``: one autograd function around an engine's ``Render``."""

from dataclasses import replace
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

    shared = (tensors.opacities, tensors.sigma, tensors.viewmats, tensors.Ks)
    inputs = Inputs(tensors.vertices, channels.flat, channels.corner, *shared, backgrounds)
    first, *rest = _parts(inputs, render.most_channels)
    plan = Plan(render, settings, geometry, len(tensors.viewmats))
    color, alpha, distortion, median_triangle = _rasterize(plan, *first)
    if rest:
        plain = settings._replace(outputs=settings.outputs - {"statistics", "distortion", "median_depth"})
        others = replace(plan, settings=plain)
        color = torch.cat([color, *(_rasterize(others, *part)[0] for part in rest)], dim=-1)
    result = Rasterization(color=color, alpha=alpha, distortion=distortion, statistics=plan.statistics)
    if median_triangle is not None:
        result.median_depth = median_depth(median_triangle, channels, tensors, engine)
    channels.split(result)
    return result


def _parts(inputs: Inputs, most: int | None) -> list[Inputs]:
    """All channels, or, where they are more than ``most``, parts that lie next to each other in the image."""
    flat, corner, backgrounds = inputs.flat, inputs.corner, inputs.backgrounds
    if most is None or sum(inputs.channels) <= most:
        return [inputs]
    # A triangle with any channel that is not finite is to be left out of every part.
    finite = torch.ones((), dtype=torch.bool, device=inputs.vertices.device)
    for channels, dims in ((flat, -1), (corner, (-2, -1))):
        finite = finite if channels is None else finite & channels.isfinite().all(dim=dims)
    parts, at = [], 0
    for channels, mask in ((flat, finite[..., None]), (corner, finite[..., None, None])):
        for begin in range(0, channel_count(channels), most):
            chosen = torch.where(mask, channels[..., begin : begin + most], torch.nan)
            behind = None if backgrounds is None else backgrounds[:, at : at + chosen.shape[-1]]
            kinds = (chosen, None) if channels is flat else (None, chosen)
            parts.append(inputs._replace(flat=kinds[0], corner=kinds[1], backgrounds=behind))
            at += chosen.shape[-1]
    return parts


def _forward(keep: bool, plan: Plan, *given: Tensor) -> tuple[tuple[Tensor | None, ...], Any]:
    """(colour of all channels, alpha, distortion, median triangle); the latter two are None unless asked for."""
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
