"""Stands in for gsplat 1.5.3 where there is no GPU: the same arguments and shapes, round blobs for Gaussians."""

from types import SimpleNamespace
from typing import ClassVar

import torch

__version__ = "fake"


def rasterization(**arguments):
    """(1, H, W, 3), (1, H, W, 1), info: one camera."""
    color, alpha, _, info = _draw(**arguments)
    return color, alpha, info


def rasterization_2dgs(*, render_mode, **arguments):
    """Colours (with depth where asked for), alpha, normals, normals of the depth, distortion, median depth, info."""
    count = len(arguments["means"])
    pull = torch.zeros(1, count, 2, requires_grad=True)  # a leaf of its own, in gsplat too
    color, alpha, depth, info = _draw(**arguments, pull=pull)
    info["gradient_2dgs"] = pull
    normal = torch.nn.functional.normalize(arguments["quats"].mean(dim=0)[:3], dim=0).expand_as(color)
    if render_mode == "RGB":
        return color, alpha, normal, None, alpha, alpha, info
    assert render_mode == "RGB+ED"
    of_depth = torch.nn.functional.normalize(torch.cat([depth, depth, depth], dim=-1), dim=-1)[0]  # (H, W, 3)
    return torch.cat([color, depth], dim=-1), alpha, normal, of_depth, alpha, alpha, info


def _draw(
    means,
    quats,
    scales,
    opacities,
    colors,
    viewmats,
    Ks,
    width,
    height,
    *,
    near_plane,
    sh_degree,
    packed,
    backgrounds,
    pull=0.0,
):
    count, bands = len(means), colors.shape[1]
    assert (means.shape, quats.shape, scales.shape) == ((count, 3), (count, 4), (count, 3))
    assert opacities.shape == (count,)
    assert colors.shape == (count, bands, 3)
    assert bands >= (sh_degree + 1) ** 2
    assert (viewmats.shape, Ks.shape, backgrounds.shape) == ((1, 4, 4), (1, 3, 3), (1, 3))
    assert {each.dtype for each in (means, quats, scales, opacities, colors, viewmats, Ks, backgrounds)} == {
        torch.float32
    }
    assert type(width) is type(height) is int
    assert not packed
    points = means @ viewmats[0, :3, :3].T + viewmats[0, :3, 3]
    depths = points[:, 2].clamp_min(near_plane)
    means2d = (points[:, :2] / depths[:, None] * torch.diagonal(Ks[0])[:2] + Ks[0, :2, 2])[None]
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    offsets = torch.stack([x, y], dim=-1)[..., None, :] - (means2d + pull)[0]
    radius = scales[:, :2].mean(dim=1) * Ks[0, 0, 0] / depths + 0.5
    visible = points[:, 2] > near_plane
    weight = opacities * visible * torch.exp(-0.5 * offsets.square().sum(dim=-1) / radius**2)
    alpha = 1 - torch.exp(-weight.sum(dim=-1, keepdim=True))
    shares = weight / (weight.sum(dim=-1, keepdim=True) + 1e-6)
    color = alpha * (shares @ (0.5 + 0.28209 * colors[:, 0])) + (1 - alpha) * backgrounds[0]
    info = {"width": width, "height": height, "n_cameras": 1, "gaussian_ids": None, "means2d": means2d}
    info["radii"] = (torch.ones(1, count, 2) * visible[:, None]).int()
    return color[None], alpha[None], (shares @ depths)[None, ..., None], info


class DefaultStrategy:
    """Records when it is called; doubles the Gaussians once, at `refine_start_iter`; never resets opacities (1.5.3)."""

    made: ClassVar[list] = []

    def __init__(self, *, prune_opa, refine_start_iter, refine_stop_iter, refine_every, reset_every, key_for_gradient):
        self.schedule = (refine_start_iter, refine_stop_iter, refine_every, reset_every)
        self.prune_opa, self.key = prune_opa, key_for_gradient
        self.steps = []
        self.made.append(self)

    def check_sanity(self, params, optimizers):
        assert {name for name, parameter in params.items() if parameter.requires_grad} == set(optimizers)
        assert {"means", "scales", "quats", "opacities"} <= set(params)
        assert all(len(optimizer.param_groups) == 1 for optimizer in optimizers.values())

    def initialize_state(self, scene_scale=1.0):
        return {"grad2d": None, "scene_scale": scene_scale}

    def step_pre_backward(self, params, optimizers, state, step, info):
        info[self.key].retain_grad()

    def step_post_backward(self, params, optimizers, state, step, info, packed=False):
        assert info[self.key].grad.shape == (1, len(params["means"]), 2)
        assert {"width", "height", "n_cameras", "radii", "gaussian_ids"} <= set(info)
        self.steps.append(step)
        norms = info[self.key].grad[0].norm(dim=1)
        state["grad2d"] = norms if state["grad2d"] is None else state["grad2d"] + norms
        self.pulls = state["grad2d"].clone()
        if step != self.schedule[0]:
            return
        offsets = 1e-3 * torch.randn_like(params["means"])

        def double(name, values):
            return torch.cat([values, values + offsets if name == "means" else values])

        _change(params, optimizers, double, lambda moment: torch.cat([moment, torch.zeros_like(moment)]))
        state["grad2d"] = torch.zeros(len(params["means"]))


def _reset_opa(params, optimizers, state, value):
    limit = torch.logit(torch.tensor(value)).item()
    _change(params, optimizers, lambda _, values: values.clamp(max=limit), torch.zeros_like, ["opacities"])


def _change(params, optimizers, change, change_moment, names=None):
    """Replaces parameters, as gsplat does, and moves their moments to the new ones."""
    for name in names or list(params):
        optimizer, old = optimizers[name], params[name]
        new = torch.nn.Parameter(change(name, old.detach()))
        moments = optimizer.state.pop(old, {})
        optimizer.state[new] = {k: v if k == "step" else change_moment(v) for k, v in moments.items()}
        optimizer.param_groups[0]["params"] = [new]
        params[name] = new


strategy = SimpleNamespace(ops=SimpleNamespace(reset_opa=_reset_opa))
