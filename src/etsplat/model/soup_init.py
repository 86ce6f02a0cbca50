"""Where a soup starts: one triangle at each point of a sparse reconstruction, or at random points."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from etsplat.core.precision import usual_defaults
from etsplat.core.short_repr import short_repr
from etsplat.core.validation import check_above, check_finite, check_kind, check_shape
from etsplat.model.triangle_soup import TriangleSoup

NEIGHBOURS = 3
SKY_FRACTION = 0.05
VIEWED_FRACTION = 1.3 / 4.03
"""Half the side of the cube that is filled with random points, relative to the distance of the cameras from its centre:
that of the NeRF-synthetic scenes, whose cube reaches to 1.3 and whose cameras are 4.03 away."""
_SMALLEST_SQUARE = 1e-7


@dataclass(frozen=True, eq=False)
class StartPoints:
    """Points to put triangles at.

    Attributes:
        positions: (P, 3).
        colors: (P, 3) in [0, 1].

    Raises:
        ValueError: they are no such tensors, or not finite.

    Example:
        >>> points = etsplat.StartPoints(torch.rand(100, 3), torch.full((100, 3), 0.5))
        >>> soup = etsplat.start_soup(points, torch.Generator(), scale=1.0, opacity=0.3, sigma=1.0, sh_degree=0)
        >>> soup.count
        100
    """

    __repr__ = short_repr

    positions: Float[Tensor, "P 3"]
    colors: Float[Tensor, "P 3"]

    def __post_init__(self) -> None:
        check_shape("positions", self.positions, ("P", 3))
        check_shape("colors", self.colors, (len(self.positions), 3))
        check_finite("positions", self.positions)

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def span(self) -> float:
        """Longest side of the box around them; 0 of none."""
        return float((self.positions.amax(dim=0) - self.positions.amin(dim=0)).max()) if len(self) else 0.0

    def with_sky(self) -> "StartPoints":
        """The same after 5 % more on a white sphere about the origin that reaches the farthest coordinate."""
        count = int(SKY_FRACTION * len(self))
        radius = float(self.positions.abs().max()) if len(self) else 0.0
        sky = radius * fibonacci_sphere(count).to(self.positions)
        white = torch.ones_like(sky)
        return StartPoints(torch.cat([sky, self.positions]), torch.cat([white, self.colors]))


def random_points(count: int, viewmats: Float[Tensor, "B 4 4"], generator: torch.Generator) -> StartPoints:
    """Grey points, uniform in a cube about the place that the cameras look at: for captures without points.

    Args:
        count: how many.
        viewmats: (B, 4, 4) float64, world to camera.
        generator: of the positions.
    """
    forward = viewmats[:, 2, :3]
    centers = -torch.einsum("bji,bj->bi", viewmats[:, :3, :3], viewmats[:, :3, 3])
    # The point nearest to all optical axes: sum (I - f f^T) (p - c) = 0. Axes that are parallel leave a direction open.
    across = torch.eye(3, dtype=viewmats.dtype) - forward[:, :, None] * forward[:, None, :]
    middle = torch.linalg.pinv(across.sum(dim=0), rtol=1e-6) @ torch.einsum("bij,bj->i", across, centers)
    half_side = VIEWED_FRACTION * (centers - middle).norm(dim=1).mean()
    unit = 2 * torch.rand((count, 3), generator=generator) - 1
    return StartPoints((middle + half_side * unit.double()).float(), torch.full((count, 3), 0.5))


def fibonacci_sphere(count: int) -> Float[Tensor, "N 3"]:
    """Points spread evenly over the unit sphere: equal steps in z, golden-angle steps about it."""
    index = torch.arange(count, dtype=torch.float64)
    z = 1 - (2 * index + 1) / max(count, 1)
    angle = index * math.pi * (3 - math.sqrt(5))
    radius = (1 - z * z).clamp_min(0).sqrt()
    return torch.stack([radius * angle.cos(), radius * angle.sin(), z], dim=-1).float()


def spacing(positions: Float[Tensor, "P 3"]) -> Float[Tensor, " P"]:
    """Root of the mean squared distance to the three nearest other points (as many as there are).

    A point without neighbours has spacing sqrt(1e-7), which no other falls below either.
    """
    neighbours = min(NEIGHBOURS, len(positions) - 1)
    if neighbours < 1:
        return positions.new_full((len(positions),), math.sqrt(_SMALLEST_SQUARE))
    points = positions.double().numpy()
    distances, _ = KDTree(points).query(points, k=neighbours + 1)
    squares = torch.from_numpy(distances[:, 1:] ** 2).mean(dim=1)
    return squares.clamp_min(_SMALLEST_SQUARE).sqrt().to(positions)


@usual_defaults()
def start_soup(
    points: StartPoints,
    generator: torch.Generator,
    *,
    scale: float,
    opacity: float,
    sigma: float,
    sh_degree: int,
    centers: Float[Tensor, "B 3"] | None = None,
    limit: float | None = None,
) -> TriangleSoup:
    """One right-angled isosceles triangle per point, turned at random, about as large as the gap to its neighbours.

    Its corners are p + r R u with r = scale times `spacing`, u = +z, a direction across, and -z, and R a rotation by a
    uniform angle about a uniform axis (Triangle Splatting's start).

    Args:
        points: where.
        generator: of the rotations.
        scale: size of a triangle relative to the spacing.
        opacity: of all.
        sigma: of all.
        sh_degree: of the colours.
        centers: positions of the cameras, where there is a limit.
        limit: no triangle is larger than this times its distance to the nearest camera; None for any size. Without it,
            triangles at stray points near the cameras cover whole pictures.

    Raises:
        ValueError: a number out of its range.

    Example:
        >>> points = etsplat.StartPoints(torch.rand(50, 3), torch.rand(50, 3))
        >>> chance = torch.Generator().manual_seed(0)
        >>> etsplat.start_soup(points, chance, scale=1.0, opacity=0.5, sigma=1.0, sh_degree=1).count
        50
    """
    check_above("scale", scale)
    check_kind("generator", generator, torch.Generator)
    count = len(points)
    radius = scale * spacing(points.positions)
    if limit is not None and centers is not None and count:
        distances, _ = KDTree(centers.double().numpy()).query(points.positions.double().numpy())
        radius = torch.minimum(radius, limit * torch.from_numpy(distances).to(radius))
    axis = torch.nn.functional.normalize(torch.randn((count, 3), generator=generator), dim=1)
    angle = 2 * math.pi * torch.rand((count, 1), generator=generator)
    turned = [_rotate(torch.tensor(u).expand(count, 3), axis, angle) for u in ((0.0, 0, 1), (1.0, 0, 0), (0.0, 0, -1))]
    corners = points.positions[:, None] + radius[:, None, None] * torch.stack(turned, dim=1).to(points.positions)
    return TriangleSoup.from_triangles(corners, points.colors, opacity=opacity, sigma=sigma, sh_degree=sh_degree)


def _rotate(
    vectors: Float[Tensor, "N 3"], axis: Float[Tensor, "N 3"], angle: Float[Tensor, "N 1"]
) -> Float[Tensor, "N 3"]:
    """Rodrigues' formula."""
    along = (axis * vectors).sum(dim=1, keepdim=True) * axis
    return along + (vectors - along) * angle.cos() + torch.linalg.cross(axis, vectors) * angle.sin()
