"""Camera paths through a capture: around what its cameras look at, or from one of them to the next."""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.cameras import camera_centers, look_at
from etsplat.core.validation import check_count, check_finite, check_floating, check_shape

Viewmats = Float[Tensor, "B 4 4"]

MAX_FRAMES = 1_000_000
"""Of a path, which is made as a whole."""


def axes_meeting_point(viewmats: Viewmats, least: float = 1e-4) -> Float[Tensor, "3"] | None:
    """The point with the least sum of squared distances to the cameras' optical axes, float64.

    For an axis through c along the unit vector d the distance is |(I - d d^T)(x - c)|, so x solves
    sum(I - d d^T) x = sum(I - d d^T) c. None if axes are parallel: an eigenvalue of the mean matrix is below `least`.
    """
    centers, forward = camera_centers(viewmats.double()), viewmats[:, 2, :3].double()
    projections = torch.eye(3, dtype=torch.float64) - forward[:, :, None] * forward[:, None, :]
    total = projections.sum(dim=0)
    if float(torch.linalg.eigvalsh(total)[0]) < least * len(viewmats):
        return None
    return torch.linalg.solve(total, (projections @ centers[:, :, None]).sum(dim=0)[:, 0])


def focus_point(viewmats: Viewmats) -> Float[Tensor, "3"]:
    """Where the optical axes meet best, float64; if nowhere, ahead of the mean camera by the spread of the cameras."""
    met = axes_meeting_point(viewmats, least=1e-3)
    if met is not None:
        return met
    centers = camera_centers(viewmats.double())
    spread = (centers - centers.mean(dim=0)).norm(dim=1).max()
    return centers.mean(dim=0) + viewmats[:, 2, :3].double().mean(dim=0) * spread.clamp_min(1e-6)


def orbit(viewmats: Viewmats, up: Float[Tensor, "3"], frames: int) -> Viewmats:
    """A circle around the focus at the cameras' median distance and mean height, looking at the focus."""
    _check(viewmats, up, frames)
    focus, basis = focus_point(viewmats), _horizontal_basis(up)
    offsets = camera_centers(viewmats.double()) - focus
    flat = offsets @ basis.T
    height = (offsets @ up.double()).mean()
    radius = torch.maximum(flat.norm(dim=1).median(), 0.05 * height.abs())  # not straight above the focus
    return _around(focus, up, basis, focus, (radius, radius), lambda angle: height.expand_as(angle), frames)


def ellipse(viewmats: Viewmats, up: Float[Tensor, "3"], frames: int) -> Viewmats:
    """An ellipse through the outer cameras, along the main axes of where they stand, rising and sinking with them."""
    _check(viewmats, up, frames)
    focus, centers, basis = focus_point(viewmats), camera_centers(viewmats.double()), _horizontal_basis(up)
    middle = centers.mean(dim=0)
    flat = (centers - middle) @ basis.T
    basis = torch.linalg.eigh(flat.T @ flat).eigenvectors.T @ basis
    reach = torch.quantile(((centers - middle) @ basis.T).abs(), 0.9, dim=0).clamp_min(1e-6)
    heights = (centers - middle) @ up.double()
    swing = 0.5 * (torch.quantile(heights, 0.9) - torch.quantile(heights, 0.1))
    return _around(focus, up, basis, middle, (reach[0], reach[1]), lambda angle: swing * angle.sin(), frames)


def spiral(viewmats: Viewmats, up: Float[Tensor, "3"], frames: int) -> Viewmats:
    """Two turns around the middle camera, within half of the cameras' spread; for scenes that are seen from one side.

    `up` is not used: it is the middle camera's own.
    """
    _check(viewmats, up, frames)
    focus, centers = focus_point(viewmats), camera_centers(viewmats.double())
    offsets = centers - centers.mean(dim=0)
    middle = int(offsets.norm(dim=1).argmin())
    own = viewmats[middle, :3, :3].double()  # rows: right, down, forward
    distance = (centers[middle] - focus).norm()
    reach = torch.minimum(0.5 * torch.quantile((offsets @ own.T).abs(), 0.9, dim=0), 0.2 * distance)
    angle = torch.arange(frames, dtype=torch.float64) * (4 * math.pi / frames)
    turns = torch.stack([angle.cos() * reach[0], angle.sin() * reach[1], (0.5 * angle).sin() * reach[2]], dim=1)
    return look_at(centers[middle] + turns @ own, focus, -own[1])


def interpolated(viewmats: Viewmats, up: Float[Tensor, "3"], frames: int) -> Viewmats:
    """From camera to camera in order, at even speed: positions on Catmull-Rom splines, orientations turned evenly.

    `up` is not used: orientations are the cameras' own.
    """
    _check(viewmats, up, frames)
    centers, rotations = camera_centers(viewmats.double()), viewmats[:, :3, :3].double()
    count = len(viewmats)
    if count == 1:
        return viewmats.double().expand(frames, 4, 4)
    steps = (centers[1:] - centers[:-1]).norm(dim=1)
    # Cameras at one place still take their time to turn.
    distance = torch.cat([torch.zeros(1, dtype=torch.float64), (steps + 0.05 * steps.mean() + 1e-9).cumsum(dim=0)])
    at = torch.linspace(0, 1, frames, dtype=torch.float64) * distance[-1]
    segment = (torch.searchsorted(distance, at, right=True) - 1).clamp(0, count - 2)
    t = ((at - distance[segment]) / (distance[segment + 1] - distance[segment]))[:, None]
    p0, p1, p2, p3 = (centers[(segment + k).clamp(0, count - 1)] for k in (-1, 0, 1, 2))
    curve = p1 + 0.5 * t * (p2 - p0 + t * (2 * p0 - 5 * p1 + 4 * p2 - p3 + t * (3 * (p1 - p2) + p3 - p0)))
    turned = _turn(rotations[segment], rotations[segment + 1], t[:, 0])
    result = torch.zeros(frames, 4, 4, dtype=torch.float64)
    result[:, :3, :3], result[:, 3, 3] = turned, 1.0
    result[:, :3, 3] = -torch.einsum("bij,bj->bi", turned, curve)
    return result


PATHS: dict[str, Callable[[Viewmats, Float[Tensor, "3"], int], Viewmats]] = {
    "orbit": orbit,
    "ellipse": ellipse,
    "spiral": spiral,
    "interpolated": interpolated,
}
"""By name: (viewmats of the cameras, where up is, number of frames) to float64 viewmats of the path.

They raise ValueError where an argument has a wrong shape, dtype, device or range; the message names it.
"""


def _check(viewmats: Tensor, up: Tensor, frames: int) -> None:
    check_shape("viewmats", viewmats, ("B", 4, 4))
    check_shape("up", up, (3,))
    for name, tensor in (("viewmats", viewmats), ("up", up)):
        check_floating(name, tensor)
        if not tensor.is_cpu:
            raise ValueError(f"{name} must be on the CPU, got {tensor.device}")
        check_finite(name, tensor)
    if len(viewmats) == 0:
        raise ValueError("viewmats must hold at least one camera, got 0")
    check_count("frames", frames, most=MAX_FRAMES)


def _around(
    target: Tensor,
    up: Tensor,
    basis: Tensor,
    middle: Tensor,
    radii: tuple[Tensor, Tensor],
    height: Callable[[Tensor], Tensor],
    frames: int,
) -> Viewmats:
    angle = torch.arange(frames, dtype=torch.float64) * (2 * math.pi / frames)
    flat = torch.stack([angle.cos() * radii[0], angle.sin() * radii[1]], dim=1) @ basis
    return look_at(middle + flat + height(angle)[:, None] * up.double(), target, up.double())


def _horizontal_basis(up: Float[Tensor, "3"]) -> Float[Tensor, "2 3"]:
    """Two unit vectors at right angles to each other and to `up`."""
    axis = torch.eye(3, dtype=torch.float64)[int(up.abs().argmin())]
    first = torch.nn.functional.normalize(torch.linalg.cross(up.double(), axis), dim=0)
    return torch.stack([first, torch.linalg.cross(up.double(), first)])


def _turn(start: Float[Tensor, "B 3 3"], end: Float[Tensor, "B 3 3"], t: Float[Tensor, " B"]) -> Float[Tensor, "B 3 3"]:
    """A part t of the shortest rotation from start to end: exp(t log(end start^T)) start."""
    between = end @ start.mT
    cosine = ((torch.diagonal(between, dim1=1, dim2=2).sum(dim=1) - 1) / 2).clamp(-1, 1)
    angle = torch.arccos(cosine)
    skew = between - between.mT
    axis = torch.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], dim=1)
    axis = axis / axis.norm(dim=1, keepdim=True).clamp_min(1e-12)
    x, y, z = axis.unbind(dim=1)
    zero = torch.zeros_like(x)
    K = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).reshape(-1, 3, 3)
    part = (t * angle)[:, None, None]
    return (torch.eye(3, dtype=torch.float64) + part.sin() * K + (1 - part.cos()) * (K @ K)) @ start
