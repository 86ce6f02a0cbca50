"""A walk along photos: in which order cameras are passed, and smooth motion from each to the next."""

import math
from itertools import pairwise

import torch
from jaxtyping import Float, Int
from scipy.ndimage import correlate1d
from scipy.sparse.csgraph import connected_components, shortest_path
from torch import Tensor

from etsplat.core.cameras import camera_centers
from etsplat.data.camera_coverage import focus_point

_MOST = 400
"""Cameras that are looked at; of more, evenly spaced ones."""

_STOPS = 24
"""Of a tour through photos that were not taken along a way."""

_WALKED = 3.0
"""Photos were taken along a way if one follows another within so many times the distance to the nearest one."""

_HOP = 3.0
"""A step so many times as long as most is no step: the way there leads past other photos, not through the scene."""

_JOINED = 4.0
"""Cameras are of one group if they are so many usual distances between neighbours apart."""


def apart(viewmats: Float[Tensor, "B 4 4"]) -> Float[Tensor, "B B"]:
    """How far cameras are from each other, turns included, float64.

    A turn by one radian counts as far as the spread of the cameras.
    """
    centers, rotations = camera_centers(viewmats.double()), viewmats[:, :3, :3].double()
    cosine = (torch.einsum("aij,bij->ab", rotations, rotations) - 1) / 2
    turns = torch.arccos(cosine.clamp(-1, 1)).fill_diagonal_(0.0)
    return torch.cdist(centers, centers) + spread_of(centers) * turns


def step_lengths(
    centers: Float[Tensor, "S 3"], rotations: Float[Tensor, "S 3 3"], spread: float
) -> Float[Tensor, " S-1"]:
    """How far each station is from the one before, as `apart` has it of cameras with that spread."""
    cosine = (torch.einsum("bij,bij->b", rotations[1:], rotations[:-1]) - 1) / 2
    return (centers[1:] - centers[:-1]).norm(dim=1) + spread * torch.arccos(cosine.clamp(-1, 1))


def spread_of(centers: Float[Tensor, "B 3"]) -> float:
    """Root of the mean squared distance from their middle; never 0."""
    return max(float((centers - centers.mean(dim=0)).square().sum(dim=1).mean().sqrt()), 1e-9)


def tour(viewmats: Float[Tensor, "B 4 4"]) -> Int[Tensor, " T"]:
    """The order in which to pass cameras: their own if they were taken along a way, else one of short steps.

    Where a step would be long, it leads past other cameras, which may come more than once for that.

    Args:
        viewmats: (B, 4, 4) world to camera, in the order of their names.

    Returns:
        (T,) indices of cameras.
    """
    chosen = torch.linspace(0, len(viewmats) - 1, min(len(viewmats), _MOST)).round().long()
    if len(chosen) < 3:
        return chosen
    distance = apart(viewmats[chosen])
    nearest = distance.clone().fill_diagonal_(math.inf).min(dim=1).values.median()
    steps = torch.diagonal(distance, offset=1)
    walked = float(steps.median()) <= _WALKED * float(nearest) + 1e-12
    order = list(range(len(chosen))) if walked else _short_order(distance, _spread_out(distance, _STOPS))
    usual = float(torch.stack([distance[a, b] for a, b in pairwise(order)]).median())
    return chosen[torch.tensor(_without_hops(order, distance, _HOP * max(usual, float(nearest)) if walked else 0.0))]


def largest_group(viewmats: Float[Tensor, "B 4 4"]) -> Int[Tensor, " M"]:
    """Indices of the most cameras between which no step is wider than half as far as what they look at is away.

    What lies between groups that are farther apart no photo shows from nearby. Steps of four times the usual distance
    between neighbours join cameras in any case.
    """
    centers = camera_centers(viewmats.double())
    chosen = torch.linspace(0, len(centers) - 1, min(len(centers), _MOST)).round().long()
    distance = torch.cdist(centers[chosen], centers[chosen])
    if len(chosen) == 1:
        return torch.zeros(1, dtype=torch.int64)
    usual = distance.clone().fill_diagonal_(math.inf).min(dim=1).values.median()
    away = (centers - focus_point(viewmats)).norm(dim=1).median()
    longest = max(0.5 * float(away), _JOINED * float(usual)) + 1e-9
    _, labels = connected_components((distance <= longest).numpy(), directed=False)
    most = int(torch.from_numpy(labels).mode().values)
    members = chosen[torch.from_numpy(labels == most)]
    return (torch.cdist(centers, centers[members]).min(dim=1).values <= longest).nonzero()[:, 0]


def _spread_out(distance: Float[Tensor, "B B"], count: int) -> list[int]:
    """So many cameras, each as far as possible from those before it, from the one nearest to all others on."""
    found = [int(distance.sum(dim=1).argmin())]
    left = distance[found[0]].clone()
    while len(found) < min(count, len(distance)):
        found.append(int(left.argmax()))
        left = torch.minimum(left, distance[found[-1]])
    return found


def _short_order(distance: Float[Tensor, "B B"], stops: list[int]) -> list[int]:
    """The stops in an order of short steps: always to the nearest, from an outer one; then stretches are reversed."""
    between = distance[stops][:, stops]
    order = [int(between.sum(dim=1).argmax())]
    while len(order) < len(stops):
        following = between[order[-1]].clone()
        following[order] = math.inf
        order.append(int(following.argmin()))
    table, improved = between.tolist(), True
    while improved:
        improved = False
        for first in range(len(order) - 1):
            for last in range(first + 1, len(order)):
                before = table[order[first - 1]][order[first]] if first else 0.0
                behind = table[order[last]][order[last + 1]] if last + 1 < len(order) else 0.0
                now = (table[order[first - 1]][order[last]] if first else 0.0) + (
                    table[order[first]][order[last + 1]] if last + 1 < len(order) else 0.0
                )
                if now < before + behind - 1e-9:
                    order[first : last + 1] = order[first : last + 1][::-1]
                    improved = True
    return [stops[index] for index in order]


def _without_hops(order: list[int], distance: Float[Tensor, "B B"], longest: float) -> list[int]:
    """The order with other cameras in between where a step is longer: the way of the least sum of squared steps."""
    squared = distance.square()
    _, before = shortest_path(squared.numpy(), return_predecessors=True)
    result = order[:1]
    for start, end in pairwise(order):
        way = [end]
        if float(distance[start, end]) > longest:
            while (previous := int(before[start, way[-1]])) not in (start, -9999):
                way.append(previous)
        result += reversed(way)
    return result


def splined(
    viewmats: Float[Tensor, "T 4 4"], steps: Float[Tensor, " S"], frames: int
) -> tuple[Float[Tensor, "F 3"], Float[Tensor, "F 3 3"]]:
    """Positions on Catmull-Rom splines through cameras, and orientations turned evenly from each to the next, float64.

    Args:
        viewmats: (T, 4, 4) world to camera, T >= 2.
        steps: (T - 1,) how long each step takes, > 0.
        frames: number of stations, evenly spaced in time.
    """
    centers, rotations = camera_centers(viewmats.double()), viewmats[:, :3, :3].double()
    count = len(viewmats)
    time = torch.cat([torch.zeros(1, dtype=torch.float64), steps.cumsum(dim=0)])
    at = torch.linspace(0, 1, frames, dtype=torch.float64) * time[-1]
    segment = (torch.searchsorted(time, at, right=True) - 1).clamp(0, count - 2)
    # Beside a long step a short one is lost, and takes no time.
    t = ((at - time[segment]) / (time[segment + 1] - time[segment]).clamp_min(1e-300))[:, None]
    p0, p1, p2, p3 = (centers[(segment + k).clamp(0, count - 1)] for k in (-1, 0, 1, 2))
    curve = p1 + 0.5 * t * (p2 - p0 + t * (2 * p0 - 5 * p1 + 4 * p2 - p3 + t * (3 * (p1 - p2) + p3 - p0)))
    return curve, _turn(rotations[segment], rotations[segment + 1], t[:, 0])


def smoothed(values: Float[Tensor, "F C"], width: float) -> Float[Tensor, "F C"]:
    """Means with Gaussian weights along the first axis; `width` is the standard deviation in rows."""
    reach = min(max(1, math.ceil(3 * width)), len(values) - 1)
    kernel = torch.exp(-0.5 * (torch.arange(-reach, reach + 1, dtype=values.dtype) / max(width, 1e-3)).square())
    columns = torch.cat([values, torch.ones_like(values[:, :1])], dim=1).detach()
    # torch's own convolution of so wide a kernel takes hundreds of megabytes.
    sums = torch.from_numpy(correlate1d(columns.numpy(), kernel.numpy(), axis=0, mode="constant"))
    return sums[:, :-1] / sums[:, -1:]


def nearest_rotations(matrices: Float[Tensor, "F 3 3"]) -> Float[Tensor, "F 3 3"]:
    """The rotations nearest to some matrices."""
    left, _, right = torch.linalg.svd(matrices)
    signs = torch.ones_like(matrices[:, 0])
    signs[:, 2] = torch.linalg.det(left @ right)
    return (left * signs[:, None]) @ right


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
