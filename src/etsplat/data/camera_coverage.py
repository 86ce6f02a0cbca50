"""From which sides cameras look at something: how far round it, how far away, how high."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.cameras import camera_centers

WIDEST_GAP = math.radians(60)
"""Between neighbouring cameras' azimuths: what lies in a wider one, no photo shows from within 30 degrees."""

_UNEVEN = 1.25
"""Few cameras that stand evenly all around have wider gaps: so many times the mean one is still none."""

_STRAY, _STRAY_GAP = 0.1, math.radians(30)
"""So small a part of the cameras does not widen an arc at whose end it stands behind such a gap."""

_LEAST = math.radians(10)
"""A smaller arc is no way around anything."""

_LOOKS = math.cos(math.radians(60))
"""A camera looks at what is no farther than this from its axis."""

_STEEPEST = math.radians(80)
"""Cameras higher or lower above what they look at stand at no azimuth."""

_BLUR = math.radians(12)
"""Standard deviation of the azimuths over which distances and heights are averaged, at least."""

INSET = 0.05
"""Of an arc that does not go all around, left out at each end: what is seen there is at the border of all photos."""


def axes_meeting_point(viewmats: Float[Tensor, "B 4 4"], least: float = 1e-4) -> Float[Tensor, "3"] | None:
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


def focus_point(viewmats: Float[Tensor, "B 4 4"]) -> Float[Tensor, "3"]:
    """Where the optical axes meet best, float64; if nowhere, ahead of the mean camera by the spread of the cameras."""
    met = axes_meeting_point(viewmats, least=1e-3)
    if met is not None:
        return met
    centers = camera_centers(viewmats.double())
    spread = (centers - centers.mean(dim=0)).norm(dim=1).max()
    return centers.mean(dim=0) + viewmats[:, 2, :3].double().mean(dim=0) * spread.clamp_min(1e-6)


def horizontal_basis(up: Float[Tensor, "3"]) -> Float[Tensor, "2 3"]:
    """Two unit vectors at right angles to each other and to `up`, float64."""
    axis = torch.eye(3, dtype=torch.float64)[int(up.abs().argmin())]
    first = torch.nn.functional.normalize(torch.linalg.cross(up.double(), axis), dim=0)
    return torch.stack([first, torch.linalg.cross(up.double(), first)])


@dataclass(frozen=True)
class Coverage:
    """The arc about the focus from which cameras look at it, and where they stand along that arc.

    Attributes:
        focus: (3,) what they look at.
        up: (3,) unit vector; azimuths turn about it.
        start: azimuth in radians at which the arc begins.
        breadth: radians from there to its end; 2 pi where it goes all around.
        azimuths: (M,) radians of the cameras within the arc, from `start` on.
        elevations: (M,) radians above the focus.
        distances: (M,) from the focus.
        blur: radians; standard deviation of the azimuths that are averaged over.
    """

    focus: Float[Tensor, "3"]
    up: Float[Tensor, "3"]
    start: float
    breadth: float
    azimuths: Float[Tensor, " M"]
    elevations: Float[Tensor, " M"]
    distances: Float[Tensor, " M"]
    blur: float

    @property
    def all_around(self) -> bool:
        """Whether cameras stand on every side."""
        return self.breadth >= 2 * math.pi

    def stations(self, azimuths: Float[Tensor, " F"], lift: Float[Tensor, " F"] | None = None) -> Float[Tensor, "F 3"]:
        """Where the cameras near some azimuths stand on the mean, float64.

        Args:
            azimuths: (F,) radians, counted from `start`.
            lift: (F,) in standard deviations of the elevations there, above their mean; None for the mean.
        """
        apart = torch.remainder(azimuths[:, None] - self.azimuths + math.pi, 2 * math.pi) - math.pi
        weights = torch.softmax(-0.5 * (apart / self.blur).square(), dim=1)
        distance = (weights @ _without_outliers(self.distances).log()).exp()
        heights = _without_outliers(self.elevations)
        elevation = weights @ heights
        if lift is not None:
            swing = (weights * (heights - elevation[:, None]).square()).sum(dim=1).sqrt()
            elevation = elevation + lift * swing
        first, second = horizontal_basis(self.up)
        turned = (azimuths + self.start)[:, None]
        flat = elevation.cos()[:, None] * (turned.cos() * first + turned.sin() * second)
        return self.focus + distance[:, None] * (flat + elevation.sin()[:, None] * self.up)


def coverage(viewmats: Float[Tensor, "B 4 4"], up: Float[Tensor, "3"]) -> Coverage | None:
    """The arc from which cameras look at what they look at; of several arcs the one with the most cameras.

    Args:
        viewmats: (B, 4, 4) world to camera.
        up: (3,) unit vector.

    Returns:
        None where fewer than half of the cameras look at one place from the side, as they stand within what they show,
        and where all do so from the same side, as on the way to a door.
    """
    focus, up = focus_point(viewmats), up.double()
    offsets = camera_centers(viewmats.double()) - focus
    distances = offsets.norm(dim=1).clamp_min(1e-9)
    elevations = torch.asin((offsets @ up / distances).clamp(-1, 1))
    towards = -(offsets * viewmats[:, 2, :3].double()).sum(dim=1) / distances
    looking = (towards > _LOOKS) & (elevations.abs() < _STEEPEST)
    if 2 * int(looking.sum()) < len(viewmats):
        return None
    flat = offsets[looking] @ horizontal_basis(up).T
    azimuths = torch.atan2(flat[:, 1], flat[:, 0])
    start, breadth, widest = _longest_arc(azimuths)
    if breadth < _LEAST:
        return None
    turned = torch.remainder(azimuths - start + 1e-9, 2 * math.pi)
    within = turned <= breadth + 1e-6
    blur = max(_BLUR, widest / 3)
    kept = turned[within], elevations[looking][within], distances[looking][within]
    return Coverage(focus, up, start, breadth, *kept, blur)


def _longest_arc(azimuths: Float[Tensor, " M"]) -> tuple[float, float, float]:
    """Start and breadth of the arc with the most azimuths, and the widest gap within it, in radians."""
    ordered = azimuths.sort().values
    gaps = torch.remainder(ordered.roll(-1) - ordered, 2 * math.pi)
    if float(gaps.sum()) < math.pi:  # all at the same azimuth
        return float(ordered[0]), 0.0, 0.0
    sides = len((azimuths / math.radians(10)).floor().unique())
    limit = WIDEST_GAP if sides == 1 else max(WIDEST_GAP, _UNEVEN * 2 * math.pi / sides)
    breaks = (gaps > limit + 1e-6).nonzero()[:, 0].tolist()
    if not breaks:
        return float(azimuths[0]), 2 * math.pi, float(gaps.max())
    arcs = []
    for last, following in zip(breaks, [*breaks[1:], breaks[0] + len(ordered)], strict=True):
        members = [index % len(ordered) for index in range(last + 1, following + 1)]
        members = _without_strays(members, gaps.tolist())
        inner = gaps[members[:-1]]
        arcs.append((len(members), float(inner.sum()), float(ordered[members[0]]), float(max([0.0, *inner.tolist()]))))
    _, breadth, start, widest = max(arcs)
    return start, breadth, widest


def _without_strays(members: list[int], gaps: list[float]) -> list[int]:
    """Without the few at either end that stand apart; `gaps` follow the azimuths by index."""
    few = int(_STRAY * len(members))
    for count in range(few, 0, -1):
        if gaps[members[count - 1]] > _STRAY_GAP:
            members = members[count:]
            break
    for count in range(few, 0, -1):
        if gaps[members[-count - 1]] > _STRAY_GAP:
            return members[:-count]
    return members


def _without_outliers(values: Float[Tensor, " M"]) -> Float[Tensor, " M"]:
    low, high = torch.quantile(values, torch.tensor([0.1, 0.9], dtype=values.dtype))
    return values.clamp(float(low), float(high))
