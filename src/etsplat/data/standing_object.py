"""An object on a table, a floor or the ground: what stands on the surface that photos show most of, in their middle.

Space is cut into cells. A cell is filled where more photos' depth maps show a surface in it than look through it. What
is connected well above the surface, and within the frame of nearly all photos, is the object, with what is below it
down to the surface. Depths alone decide, no colours; nothing is learned.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from scipy import ndimage
from scipy.spatial import KDTree
from torch import Tensor

from etsplat.core.cameras import camera_centers
from etsplat.data.camera_coverage import focus_point
from etsplat.data.dataset import Dataset
from etsplat.data.depth_points import framed, on_map, project, unproject
from etsplat.data.support_planes import THICK, Plane, fitted, support_planes

_WITHIN = 0.8
"""Objects are looked for around the point that cameras look at, as far as this part of the way to near cameras."""

_COARSE, _FINE = 64, 96
"""Cells along each side: of where the object is looked for, and then of the ball around it."""

_MARGIN = 1.2
"""That ball is so many times as large as the object."""

_SIGMAS, _THINNEST = 3.0, 0.5
"""What is no higher than so many times the spread of the surface, or than this part of a cell, belongs to it."""

_HIGH = 3.0
"""Parts are told from each other where they are so many times as high: below that the surface's own bumps join them."""

_FRAMED = 0.8
"""Part of the photos that have the cells of an object in their frame, in the mean, at least."""

_LOW, _SMALL, _FEWEST = 0.1, 0.1, 20
"""Parts that are lower than this part of the highest one are bumps, and those of fewer cells than this part of the
largest one are specks; an object has so many cells at least."""

_ROUGH = 2
"""Cells by which the depths of what photos show without texture are wrong: well above the surface the object has them,
near it only those that touch its own."""

_FOOTING = 2.0
"""Cells of the plane over which it is averaged what photos show there: single ones are wrong by noise of depths."""

_SEEN_BY = 2
"""Photos that must show a surface in a cell."""

_SAMPLES = 2000
"""Points of each depth map by which planes are found."""

_HOLE = 0.01
"""Parts of a mask: larger holes stay, since whole gaps over a plain surface have wrong depths, too."""

_BLUR = 1.5
"""Pixels over which depths are averaged for normals."""

_NEIGHBOURS = np.ones((3, 3, 3), dtype=bool)


@dataclass(frozen=True)
class StandingObject:
    """What stands on a plane.

    Attributes:
        plane: the surface that it stands on.
        lowest: the height above it from which on something is the object's.
        corner: (3,) of the cells, the least coordinates.
        side: of a cell.
        filled: (G, G, G) cells with the object in them, and those around.
        footing: (G, G) cells of the plane, as large, above which photos show something low more often than the plane
            itself, as the floor of a mug. Their middle is below that of the others.
    """

    plane: Plane
    lowest: float
    corner: Float[Tensor, "3"]
    side: float
    filled: Bool[Tensor, "G G G"]
    footing: Bool[Tensor, "G G"]

    def holds(self, points: Float[Tensor, "P 3"]) -> Bool[Tensor, " P"]:
        """Which points of surfaces are of the object."""
        at = ((points - self.corner) / self.side).floor().long()
        count = len(self.filled)
        inside = ((at >= 0) & (at < count)).all(dim=1)
        x, y, z = at.clamp(0, count - 1).unbind(dim=1)
        return inside & self.filled[x, y, z] & (self.plane.heights(points) > self.lowest)

    def is_around(self, points: Float[Tensor, "P 3"], eye: Float[Tensor, "3"]) -> Bool[Tensor, " P"]:
        """Which points are surely of the surroundings: of the plane where nothing is on it, or farther away than that.

        What is seen through the plane is where it is seen through it.

        Args:
            points: of surfaces that a camera shows.
            eye: its place, above the plane.
        """
        heights = self.plane.heights(points)
        above = self.plane.heights(eye[None]).clamp_min(1e-12)
        along = (above / (above - heights.clamp_max(0.0)))[:, None]  # 1 of what is above the plane
        free = ~self.footing.reshape(-1)[self.cells_below(eye + along * (points - eye))]
        at = (points - self.corner) / self.side
        return (free & (heights <= self.lowest)) | ((at < 0) | (at >= len(self.filled))).any(dim=1)

    def cells_below(self, points: Float[Tensor, "P 3"]) -> Int64[Tensor, " P"]:
        """The numbers of the cells of the plane that points are above; those at the border stand for all outside."""
        count = len(self.footing)
        middle = self.plane.places((self.corner + 0.5 * len(self.filled) * self.side)[None])
        at = ((self.plane.places(points) - middle) / self.side + count / 2).floor().long().clamp(0, count - 1)
        return at[:, 0] * count + at[:, 1]

    @property
    def ball(self) -> tuple[Float[Tensor, "3"], float]:
        """The middle of its cells, and the distance of the farthest from it."""
        places = self.corner + (self.filled.nonzero().double() + 0.5) * self.side
        middle = (places.amin(dim=0) + places.amax(dim=0)) / 2
        return middle, float((places - middle).norm(dim=1).max())


def find_standing(dataset: Dataset, depths: Mapping[int, Float[Tensor, "H W"]]) -> StandingObject | None:
    """The object in the middle of photos, if there is a surface that it stands on.

    Of the surfaces below the cameras, the largest first, the first one counts that something stands on which nearly all
    photos have in their frame. Then the same is asked with smaller cells where that is.

    Args:
        dataset: whose views they are.
        depths: by view, depths along the optical axis in the data set's frame, 0 where not known; of views all around.
    """
    views = sorted(depths)
    eyes, middle = camera_centers(dataset.viewmats[views]), focus_point(dataset.viewmats[views])
    near = float(torch.quantile((eyes - middle).norm(dim=1), 0.1))
    radius = _WITHIN * near
    parts = [_surface(dataset, view, depths[view]) for view in views]
    points, normals = (torch.cat(each) for each in zip(*parts, strict=True))
    around = (points - middle).norm(dim=1) < radius
    points, normals = points[around], normals[around]
    for plane in support_planes(points, normals, eyes, radius):
        found = _standing_on(plane, dataset, depths, middle, radius, _COARSE)
        if found is None:
            continue
        place, reach = found.ball
        reach *= _MARGIN
        beside = (plane.feet(points) - plane.feet(place[None])).norm(dim=1) < reach
        flat = fitted(plane, points[beside], normals[beside], min(THICK * radius, 2 * found.lowest))
        return _with_footing(_standing_on(flat, dataset, depths, place, reach, _FINE) or found, dataset, depths)
    return None


def mask_of(found: StandingObject, dataset: Dataset, view: int, depth: Float[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
    """Where a photo shows the object.

    Args:
        found: the object, in the frame of the data set.
        dataset: whose view it is.
        view: its index.
        depth: (H, W) as of `find_standing`.
    """
    points, known = _lifted(dataset, view, depth), depth.reshape(-1) > 0
    around = found.is_around(points, camera_centers(dataset.viewmats[[view]])[0]) | ~known
    shown = _without_specks((found.holds(points) & known).reshape(depth.shape).numpy())
    return torch.from_numpy(_filled_in(shown, around.reshape(depth.shape).numpy()))


def _standing_on(
    plane: Plane,
    dataset: Dataset,
    depths: Mapping[int, Tensor],
    middle: Float[Tensor, "3"],
    radius: float,
    count: int,
) -> StandingObject | None:
    """What stands on a plane, in a ball; None if nothing does that nearly all photos frame."""
    side = 2 * radius / count
    corner = middle - radius
    lowest = max(_SIGMAS * plane.spread, _THINNEST * side)
    cells = torch.cartesian_prod(*[torch.arange(count)] * 3)
    places = corner + (cells.double() + 0.5) * side
    heights = plane.heights(places)
    above = (heights > lowest).nonzero()[:, 0]
    filled = torch.zeros(len(cells), dtype=torch.bool)
    filled[above] = _filled(dataset, depths, places[above], side)
    well_above = heights > max(_HIGH * lowest, 2 * side)
    high = filled & well_above
    part, parts = _labelled(high, count)
    sizes = torch.bincount(part[high], minlength=parts + 1).double()
    share = torch.bincount(part[high], _framed(dataset, depths, places[high]), minlength=parts + 1) / sizes
    tops = torch.zeros(parts + 1, dtype=torch.float64).scatter_reduce(0, part[high], heights[high], "amax")
    whole = share > _FRAMED  # not a number where there is no cell
    if not bool(whole.any()) or float(sizes[whole].max()) < _FEWEST:
        return None
    whole &= sizes > _SMALL * sizes[whole].max()
    own = high & (whole & (tops > _LOW * tops[whole].max()))[part]
    low = (filled & ~high).nonzero()[:, 0]
    apart = KDTree(plane.feet(places[own]).numpy()).query(plane.feet(places[low]).numpy())[0]
    own[low[torch.from_numpy(np.asarray(apart)) < 1.5 * side]] = True
    reached = _widened(own, count, 1) | (_widened(own, count, _ROUGH) & well_above)
    nowhere = torch.zeros(count, count, dtype=torch.bool)
    return StandingObject(plane, lowest, corner, side, reached.reshape(count, count, count), nowhere)


def _with_footing(found: StandingObject, dataset: Dataset, depths: Mapping[int, Tensor]) -> StandingObject:
    """The same with the cells of the plane that something low of it hides."""
    count = len(found.footing)
    low, plane = (torch.zeros(count * count, dtype=torch.int64) for _ in range(2))
    for view, depth in depths.items():
        points = _lifted(dataset, view, depth)[depth.reshape(-1) > 0]
        heights = found.plane.heights(points)
        at = found.cells_below(points)
        own = found.holds(points) & (heights < _HIGH * found.lowest)
        low += torch.bincount(at[own], minlength=count * count)
        plane += torch.bincount(at[heights.abs() <= found.lowest], minlength=count * count)
    votes = (low - plane).reshape(count, count).double().numpy()
    footing = torch.from_numpy(np.asarray(ndimage.gaussian_filter(votes, _FOOTING)) > 0)
    footing[0], footing[-1], footing[:, 0], footing[:, -1] = (False,) * 4  # what is outside of the cells
    return replace(found, footing=footing)


def _labelled(cells: Bool[Tensor, " C"], count: int) -> tuple[Int64[Tensor, " C"], int]:
    """The number of the connected part that each cell of a cube is of, from 1, and how many there are."""
    numbers = np.zeros((count, count, count), dtype=np.int32)
    ndimage.label(cells.reshape(numbers.shape).numpy(), _NEIGHBOURS, output=numbers)
    return torch.from_numpy(numbers.reshape(-1).astype(np.int64)), int(numbers.max())


def _widened(cells: Bool[Tensor, " C"], count: int, steps: int) -> Bool[Tensor, " C"]:
    """The cells of a cube, and those that are no more than so many steps from them."""
    wide = ndimage.binary_dilation(cells.reshape(count, count, count).numpy(), _NEIGHBOURS, iterations=steps)
    return torch.from_numpy(np.asarray(wide, dtype=bool).reshape(-1))


def _filled(dataset: Dataset, depths: Mapping[int, Tensor], places: Tensor, side: float) -> Bool[Tensor, " P"]:
    """In which cells more photos show a surface than look through them."""
    shown, passed = (torch.zeros(len(places), dtype=torch.int32) for _ in range(2))
    for view, depth in depths.items():
        surface, own = on_map(dataset, view, depth, places)
        behind = torch.where(surface > 0, surface - own, -torch.inf)
        shown += behind.abs() < side
        passed += behind >= side
    return (shown >= _SEEN_BY) & (shown > passed)


def _framed(dataset: Dataset, depths: Mapping[int, Tensor], places: Tensor) -> Float[Tensor, " P"]:
    """Part of the photos that have each place in their frame."""
    count = torch.zeros(len(places), dtype=torch.float64)
    for view in depths:
        count += framed(dataset, view, *project(dataset, view, places))
    return count / len(depths)


def _surface(dataset: Dataset, view: int, depth: Float[Tensor, "H W"]) -> tuple[Tensor, Tensor]:
    """Some of the points that a depth map shows, and the normals there, towards the camera."""
    points = _lifted(dataset, view, depth)
    smooth = ndimage.gaussian_filter(points.reshape(*depth.shape, 3).numpy(), (_BLUR, _BLUR, 0))
    along, down = (torch.from_numpy(np.gradient(smooth, axis=axis)) for axis in (1, 0))
    normals = torch.nn.functional.normalize(torch.linalg.cross(along, down).reshape(-1, 3), dim=1)
    eye = camera_centers(dataset.viewmats[[view]])[0]
    normals = normals * torch.sign(((eye - points) * normals).sum(dim=1, keepdim=True))
    known = (depth.reshape(-1) > 0).nonzero()[:, 0]
    chosen = known[:: max(1, len(known) // _SAMPLES)]
    return points[chosen], normals[chosen]


def _lifted(dataset: Dataset, view: int, depth: Float[Tensor, "H W"]) -> Float[Tensor, "P 3"]:
    """The point of each pixel; at the eye where the depth is not known."""
    (height, width), (across, down) = depth.shape, dataset.images.sizes[view]
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    column, row = ((columns + 0.5) * across / width).reshape(-1), ((rows + 0.5) * down / height).reshape(-1)
    return unproject(dataset, view, depth.reshape(-1).double(), column.double(), row.double())


def _without_specks(shown: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Without groups of fewer pixels than `_fewest`."""
    group = np.zeros(shown.shape, dtype=np.int32)
    ndimage.label(shown, np.ones((3, 3), dtype=bool), output=group)
    kept = np.bincount(group.reshape(-1)) >= _fewest(shown)
    kept[0] = False
    return np.asarray(kept[group], dtype=bool)


def _filled_in(shown: Bool[np.ndarray, "H W"], around: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Without holes that are specks, and small ones less than half of which shows the surroundings."""
    group = np.zeros(shown.shape, dtype=np.int32)
    ndimage.label(~shown, output=group)
    sizes, free = np.bincount(group.reshape(-1)), np.bincount(group.reshape(-1), around.reshape(-1))
    closed = ((free < sizes / 2) & (sizes < _HOLE * shown.sum())) | (sizes < _fewest(shown))
    closed[np.concatenate([group[0], group[-1], group[:, 0], group[:, -1]])] = False  # no holes
    return np.asarray(shown | closed[group], dtype=bool)


def _fewest(shown: Bool[np.ndarray, "H W"]) -> float:
    """Pixels of a square of a 200th of the longer side, two along each of its own at least."""
    return float(max(2.0, max(shown.shape) / 200) ** 2)
