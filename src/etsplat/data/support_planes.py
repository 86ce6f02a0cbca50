"""Flat surfaces that something may stand on, in what depth maps show: a table, a floor, the ground."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

THICK = 0.02
"""Points are of a plane that are no farther from it than this, as part of the radius within which planes are looked
for."""

_ALIGNED = 0.82
"""Cosine of the angle between the normals of a plane and of the surface at its points, at least."""

_ABOVE = 0.9
"""Part of the cameras that are above a plane, at least: on the side to which its surface turns."""

_PLANES, _TRIED, _LEAST = 5, 600, 0.02
"""So many planes are looked for, each the best of those at so many points, until so small a part of the points is
left."""

_POINTS, _ROUNDS = 12_000, 8
"""A plane is judged by so many points, and fitted so often to those that are of it."""

_SIGMAS = 1.4826
"""Standard deviations in a median of absolute values."""


@dataclass(frozen=True)
class Plane:
    """A plane with an upper side.

    Attributes:
        normal: (3,) unit vector, up, float64.
        point: (3,) on it.
        spread: standard deviation of its points from it.
    """

    normal: Float[Tensor, "3"]
    point: Float[Tensor, "3"]
    spread: float

    def heights(self, points: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N"]:
        """How far points are above it; below it is negative."""
        return (points - self.point) @ self.normal

    def places(self, points: Float[Tensor, "N 3"]) -> Float[Tensor, "N 2"]:
        """Where points are along two directions of the plane, from its own point on."""
        first = torch.linalg.cross(self.normal, torch.eye(3).to(self.normal)[int(self.normal.abs().argmin())])
        first = torch.nn.functional.normalize(first, dim=0)
        return (points - self.point) @ torch.stack([first, torch.linalg.cross(self.normal, first)], dim=1)

    def feet(self, points: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """The points of the plane below or above others."""
        return points - self.heights(points)[:, None] * self.normal


def support_planes(
    points: Float[Tensor, "P 3"], normals: Float[Tensor, "P 3"], eyes: Float[Tensor, "B 3"], radius: float
) -> Iterator[Plane]:
    """Planes below the cameras in the order of how many points are of them, without those of planes before.

    Args:
        points: of surfaces, float64.
        normals: of the surfaces there, towards the cameras that see them.
        eyes: where the cameras are.
        radius: of where the points are.
    """
    generator = torch.Generator().manual_seed(0)
    chosen = torch.randperm(len(points), generator=generator)[:_POINTS]
    points, normals = points[chosen], normals[chosen]
    left = torch.ones(len(points), dtype=torch.bool)
    for _ in range(_PLANES):
        rows = left.nonzero()[:, 0]
        if len(rows) < max(3, _LEAST * len(points)):
            return
        tried = rows[torch.randperm(len(rows), generator=generator)[:_TRIED]]
        tried = tried[_below(points[tried], normals[tried], eyes)]
        if not len(tried):
            return
        offsets = points @ normals[tried].T - (points[tried] * normals[tried]).sum(dim=1)
        near = (offsets.abs() < THICK * radius) & (normals @ normals[tried].T > _ALIGNED) & left[:, None]
        best = tried[int(near.sum(dim=0).argmax())]
        plane = fitted(Plane(normals[best], points[best], 0.0), points[left], normals[left], THICK * radius)
        left &= plane.heights(points).abs() >= THICK * radius
        if bool(_below(plane.point[None], plane.normal[None], eyes)):
            yield plane


def fitted(plane: Plane, points: Float[Tensor, "P 3"], normals: Float[Tensor, "P 3"], thick: float) -> Plane:
    """A plane through those points that are of another one; that itself where fewer than three are.

    Args:
        plane: to begin with.
        points: (P, 3).
        normals: of the surface there.
        thick: points are no farther from it.
    """
    for _ in range(_ROUNDS):
        own = points[_of(plane, points, normals, thick)]
        if len(own) < 3:
            return plane
        middle = own.mean(dim=0)
        normal = torch.linalg.eigh((own - middle).T @ (own - middle))[1][:, 0]
        spread = _SIGMAS * float(((own - middle) @ normal).abs().median())
        plane = Plane(normal * torch.sign(normal @ plane.normal), middle, spread)
    return plane


def _of(plane: Plane, points: Tensor, normals: Tensor, thick: float) -> Bool[Tensor, " P"]:
    return (plane.heights(points).abs() < thick) & (normals @ plane.normal > _ALIGNED)


def _below(points: Tensor, normals: Tensor, eyes: Tensor) -> Bool[Tensor, " N"]:
    """Which planes have nearly all cameras above them."""
    above = normals @ eyes.T > (points * normals).sum(dim=1, keepdim=True)
    return above.double().mean(dim=1) >= _ABOVE
