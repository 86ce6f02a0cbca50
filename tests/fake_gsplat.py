"""Stands in for gsplat 1.5.3 where there is no GPU: the same arguments and shapes, round blobs for Gaussians."""

from typing import ClassVar

import torch

__version__ = "fake"


def rasterization(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height, *, near_plane, sh_degree, packed, backgrounds
):
    """(C, H, W, 3), (C, H, W, 1), info; here for one camera."""
    count = len(means)
    assert (quats.shape, scales.shape, opacities.shape) == ((count, 4), (count, 3), (count,))
    assert colors.shape[0] == count
    assert colors.shape[1] >= (sh_degree + 1) ** 2
    assert (viewmats.shape, Ks.shape, backgrounds.shape) == ((1, 4, 4), (1, 3, 3), (1, 3))
    assert not packed
    points = means @ viewmats[0, :3, :3].T + viewmats[0, :3, 3]
    depths = points[:, 2].clamp_min(near_plane)
    means2d = (points[:, :2] / depths[:, None] * torch.diagonal(Ks[0])[:2] + Ks[0, :2, 2])[None]
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    offsets = torch.stack([x, y], dim=-1)[..., None, :] - means2d[0]
    radius = scales.mean(dim=1) * Ks[0, 0, 0] / depths + 0.5
    weight = opacities * torch.exp(-0.5 * offsets.square().sum(dim=-1) / radius**2)
    alpha = 1 - torch.exp(-weight.sum(dim=-1, keepdim=True))
    shown = (weight / (weight.sum(dim=-1, keepdim=True) + 1e-6)) @ (0.5 + 0.28209 * colors[:, 0])
    color = alpha * shown + (1 - alpha) * backgrounds[0]
    info = {"width": width, "height": height, "n_cameras": 1, "gaussian_ids": None, "means2d": means2d}
    info["radii"] = torch.ones(1, count, 2, dtype=torch.int32) * (points[:, 2] > near_plane)[:, None]
    return color[None], alpha[None], info


def rasterization_2dgs(*, render_mode, **arguments):
    """Colours (with depth where asked for), alpha, normals, normals of the depth, distortion, median depth, info."""
    color, alpha, info = rasterization(**arguments)
    info["gradient_2dgs"] = info["means2d"]
    normal = torch.nn.functional.normalize(arguments["quats"].mean(dim=0)[:3], dim=0).expand_as(color)
    if render_mode == "RGB":
        return color, alpha, normal, None, None, alpha, info
    assert render_mode == "RGB+ED"
    of_depth = torch.nn.functional.normalize(torch.ones_like(normal[0]), dim=-1)
    return torch.cat([color, alpha], dim=-1), alpha, normal, of_depth, None, alpha, info


class DefaultStrategy:
    """Records when it is called; doubles the Gaussians once, at `refine_start_iter`, replacing the parameters."""

    made: ClassVar[list] = []

    def __init__(self, *, refine_start_iter, refine_stop_iter, refine_every, reset_every, key_for_gradient):
        self.schedule = (refine_start_iter, refine_stop_iter, refine_every, reset_every)
        self.key = key_for_gradient
        self.steps = []
        self.made.append(self)

    def check_sanity(self, params, optimizers):
        assert set(params) == set(optimizers)
        assert {"means", "scales", "quats", "opacities"} <= set(params)
        assert all(len(optimizer.param_groups) == 1 for optimizer in optimizers.values())

    def initialize_state(self, scene_scale=1.0):
        return {"grad2d": None, "scene_scale": scene_scale}

    def step_pre_backward(self, params, optimizers, state, step, info):
        info[self.key].retain_grad()

    def step_post_backward(self, params, optimizers, state, step, info, packed=False):
        assert info[self.key].grad.shape == (1, len(params["means"]), 2)
        self.steps.append(step)
        norms = info[self.key].grad[0].norm(dim=1)
        state["grad2d"] = norms if state["grad2d"] is None else state["grad2d"] + norms
        self.pulls = state["grad2d"].clone()
        if step != self.schedule[0]:
            return
        for name, optimizer in optimizers.items():
            new = torch.nn.Parameter(torch.cat([params[name].detach()] * 2))
            moments = optimizer.state.pop(params[name], {})
            optimizer.state[new] = {k: v if k == "step" else torch.cat([v, v]) for k, v in moments.items()}
            optimizer.param_groups[0]["params"] = [new]
            params[name] = new
        state["grad2d"] = torch.zeros(len(params["means"]))
