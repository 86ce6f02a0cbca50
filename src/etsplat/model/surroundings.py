"""What lies behind everything in a scene, its sky: a closed sphere of triangles, coloured by the photos.

Photos of few views leave gaps between what they show. Without anything behind them a gap is a hole, and the background
of a photo is learned by triangles in the air before its camera, where no other view expects them.
"""

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from etsplat.data.dataset import Dataset
from etsplat.data.pictures import as_float
from etsplat.geometry.blending import blended
from etsplat.geometry.icosphere import icosphere
from etsplat.model.triangle_soup import TriangleSoup

LEVEL = 2
SPHERE_TRIANGLES = 20 * 4**LEVEL
"""Subdivisions of the sphere, and its triangles: 320, each about sixteen degrees wide."""

OPACITY, SIGMA = 0.5, 0.4
"""Half transparent at the start: an opaque sphere would also take the place of the ground before it."""

REACH = 1.5
"""Radius of the sphere, relative to the distance within which nearly all points lie."""

BACKDROP = 2.0
"""Radius of the backdrop of an opaque mesh, relative to that of the sphere."""

_NEARLY_ALL = 0.98
_INSIDE = 0.9
_FLAT = 0.95  # triangles of so many corners lie that near to the sphere through these, with their halves


@dataclass(frozen=True)
class Surroundings:
    """The sphere around the cameras and nearly all points of a scene.

    Attributes:
        middle: (3,) mean of the training cameras.
        radius: of the sphere.
    """

    NOTE: ClassVar[str] = "sky"
    """Under this name a soup's notes say where its sky is, as `note` does; or that it has none, by any other word."""

    middle: Float[Tensor, "3"]
    radius: float

    @classmethod
    def of(cls, dataset: Dataset) -> "Surroundings":
        """Where it is. Single points far from the others do not move it."""
        centers = dataset.centers[dataset.train].float()
        middle = centers.mean(dim=0)
        everything = centers if dataset.points is None else torch.cat([centers, dataset.points])
        return cls(middle, REACH * float((everything - middle).norm(dim=1).quantile(_NEARLY_ALL)))

    @classmethod
    def dome(cls, points: Float[Tensor, "P 3"]) -> "Surroundings":
        """Where `StartPoints.with_sky` puts its triangles: about the origin, as far as the farthest coordinate."""
        return cls(torch.zeros(3), float(points.abs().max()))

    @classmethod
    def of_note(cls, note: str) -> "Surroundings | None":
        """What `note` wrote; None if that was of a soup without a sky, or is none of its notes."""
        try:
            x, y, z, radius = (float(word) for word in note.split())
        except ValueError:
            return None
        known = all(map(math.isfinite, (x, y, z, radius))) and radius > 0
        return cls(torch.tensor([x, y, z], dtype=torch.float64), radius) if known else None

    @property
    def note(self) -> str:
        """Middle and radius as a soup's notes keep them, each number to its last bit."""
        return " ".join(repr(number) for number in (*self.middle.double().tolist(), self.radius))

    def to(self, device: torch.device) -> "Surroundings":
        """The same on a device."""
        return replace(self, middle=self.middle.to(device))

    def soup(self, dataset: Dataset, sh_degree: int) -> TriangleSoup:
        """Its triangles at the start.

        A triangle has the mean colour of the photos at its centroid. One that no photo shows gets the colours of those
        nearest to it that one shows.

        Args:
            dataset: its training views are looked at.
            sh_degree: of the colours.
        """
        directions, faces = icosphere(LEVEL)
        corners = self.middle + self.radius * directions[faces]
        colors = _photographed_or_blended(dataset, corners.mean(dim=1), directions[faces].mean(dim=1))
        return TriangleSoup.from_triangles(corners, colors, opacity=OPACITY, sigma=SIGMA, sh_degree=sh_degree)

    def backdrop(self, dataset: Dataset) -> tuple[Float[Tensor, "N 3 3"], Float[Tensor, "N 3 3"]]:
        """What is to be seen through gaps between opaque triangles: a closed sphere behind that of the soup.

        Returns:
            Corners of its triangles, and the colours of these: those of the photos where the sphere of the soup is, and
            blended where no photo looks, as there.
        """
        directions, faces = icosphere(LEVEL)
        colors = _photographed_or_blended(dataset, self.middle + self.radius * directions, directions)
        return (self.middle + BACKDROP * self.radius * directions)[faces], colors[faces]

    @torch.no_grad()
    def at_backdrop(self, positions: Float[Tensor, "N 3"]) -> Bool[Tensor, " N"]:
        """Which positions are on the backdrop, on edges between its corners, or beyond."""
        return (positions - self.middle.to(positions)).norm(dim=1) > _FLAT * BACKDROP * self.radius

    @torch.no_grad()
    def outermost(self, vertices: Float[Tensor, "N 3 3"]) -> Bool[Tensor, " N"]:
        """Which triangles are on the sphere or beyond."""
        a, b, c = vertices.unbind(dim=1)  # their mean over that axis takes three times as long, for the same bits
        return ((a + b + c) / 3 - self.middle).norm(dim=1) > _INSIDE * self.radius

    @torch.no_grad()
    def facing_outwards(self, vertices: Float[Tensor, "N 3 3"]) -> Bool[Tensor, " N"]:
        """Which triangles have their corners clockwise as seen from the middle."""
        a, b, c = vertices.unbind(dim=1)
        across = torch.linalg.cross(b - a, c - a)
        return (across * (vertices.mean(dim=1) - self.middle.to(vertices))).sum(dim=1) > 0


def _photographed_or_blended(
    dataset: Dataset, positions: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"]
) -> Float[Tensor, "N 3"]:
    """Mean colours of the photos at positions; where no photo shows one, of those in the nearest directions."""
    colors, seen = _photographed(dataset, positions)
    if bool(seen.any()) and not bool(seen.all()):
        colors[~seen] = blended(directions[~seen], directions[seen], colors[seen])
    return colors


def _photographed(dataset: Dataset, positions: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "N 3"], Bool[Tensor, " N"]]:
    """Mean colour of the training photos at each position, grey where none shows it; and whether one does."""
    total, count = torch.zeros_like(positions), torch.zeros(len(positions), 1)
    for view in dataset.train:
        camera, photo = dataset.cameras[view], dataset.images[view]
        at = positions @ camera.viewmats[0, :3, :3].T + camera.viewmats[0, :3, 3]
        pixel = (at / at[:, 2:].clamp_min(1e-6)) @ camera.Ks[0].T
        inside = (at[:, 2] > 0) & (pixel[:, :2] >= 0).all(dim=1)
        inside &= (pixel[:, 0] < camera.width) & (pixel[:, 1] < camera.height)
        x, y = pixel[inside, :2].long().unbind(dim=1)
        total[inside] += as_float(photo[y, x, :3])
        count[inside] += 1
    return torch.where(count > 0, total / count.clamp_min(1), 0.5), count[:, 0] > 0
