"""A scene cut into blocks of equal content, for scenes that are larger than memory.

The cut is a grid in the ground plane. Its columns have equally many of the scene's points, and so has each block of a
column. Blocks at the rim reach to infinity, so that every place of the world is in exactly one of them.
"""

import math
import re
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.core.errors import InputError
from etsplat.core.spelling import option
from etsplat.data.dataset import Dataset

MARGIN = 0.1
"""A block is trained with what lies around it, as far as this part of its own width."""

BINS = 16
"""A photo is divided into so many bins along each side, to see what it shows; of each the nearest point counts."""

COVERED = 0.1
"""A photo belongs to the blocks that cover this part of it, and in any case to the one that covers most."""

LOOKED_AT = 200_000
"""So many points, evenly chosen, say what photos show."""

MOST_PHOTOS, MOST_POINTS = 300, 0.5
"""Of a block of "auto": training photos, and points as a part of the triangles that there may be."""

FEWEST = 2
"""Photos that a block needs to be trained with."""

_EXTENT = 0.98
"""Nearly all points lie within what counts as the width of a block at the rim."""


@dataclass(frozen=True)
class Grid:
    """A cut of the ground plane.

    Attributes:
        across: (2, 3) float64, its two axes, at right angles to each other and to up.
        columns: (C - 1,) where columns end along the first axis, ascending.
        rows: (C, R - 1) where the blocks of each column end along the second.
        low: (2,) where nearly all points begin along the axes.
        high: (2,) where they end.
    """

    across: Float[Tensor, "2 3"]
    columns: Float[Tensor, " C1"]
    rows: Float[Tensor, "C R1"]
    low: Float[Tensor, "2"]
    high: Float[Tensor, "2"]

    @property
    def shape(self) -> tuple[int, int]:
        """Columns and rows."""
        return len(self.rows), self.rows.shape[1] + 1

    def __len__(self) -> int:
        return self.shape[0] * self.shape[1]

    def name(self, block: int) -> str:
        """Its column and row, as folders are called."""
        return "{}_{}".format(*divmod(block, self.shape[1]))

    def block_of(self, points: Float[Tensor, "P 3"]) -> Int[Tensor, " P"]:
        """(P,) which block each point is in, counted column by column; on their device."""
        first, second = self._placed(points)
        column = torch.searchsorted(self.columns.to(first), first, right=True)
        rows = self.rows.to(second)[column]
        return column * self.shape[1] + (second[:, None] >= rows).sum(dim=1)

    def around(self, block: int, points: Float[Tensor, "P 3"]) -> Bool[Tensor, " P"]:
        """(P,) which points are in a block or in its margin; those of the rim have none to the outside."""
        inside = torch.ones(len(points), dtype=torch.bool, device=points.device)
        for axis, along in enumerate(self._placed(points)):
            begin, end = self._bounds(block, axis)
            margin = MARGIN * (min(end, float(self.high[axis])) - max(begin, float(self.low[axis])))
            inside &= (along >= begin - margin) & (along < end + margin)
        return inside

    def distance(self, points: Float[Tensor, "P 3"]) -> Float[Tensor, " P"]:
        """(P,) how far each point is from the nearest border between blocks, as a part of its block's width there."""
        block, nearest = self.block_of(points), points.new_full((len(points),), math.inf, dtype=torch.float64)
        for axis, along in enumerate(self._placed(points)):
            bounds = torch.tensor([self._bounds(each, axis) for each in range(len(self))], dtype=torch.float64)
            begin, end = bounds.to(along.device)[block].unbind(dim=1)
            width = end.clamp_max(float(self.high[axis])) - begin.clamp_min(float(self.low[axis]))
            nearest = torch.minimum(nearest, torch.minimum(along - begin, end - along) / width)
        return nearest

    def _placed(self, points: Float[Tensor, "P 3"]) -> tuple[Float[Tensor, " P"], Float[Tensor, " P"]]:
        first, second = (points.double() @ self.across.to(points.device).T).unbind(dim=1)
        return first.contiguous(), second.contiguous()

    def _bounds(self, block: int, axis: int) -> tuple[float, float]:
        column, row = divmod(block, self.shape[1])
        place, cuts = (column, self.columns) if axis == 0 else (row, self.rows[column])
        bounds = [-math.inf, *cuts.tolist(), math.inf]
        return bounds[place], bounds[place + 1]


def parse_blocks(text: str) -> tuple[int, int] | None:
    """Columns and rows of "3x2"; None of "auto".

    Raises:
        InputError: it is neither, or has fewer than two blocks, or more than 1024.
    """
    if text == "auto":
        return None
    found = re.fullmatch(r"([1-9][0-9]{0,3})x([1-9][0-9]{0,3})", text)
    if found is None or not 2 <= int(found[1]) * int(found[2]) <= 1024:
        raise InputError(f"blocks: is {text}; it must be columns and rows, as 3x2, of 2 to 1024 blocks, or auto")
    return int(found[1]), int(found[2])


def chosen_shape(capture: Dataset, up: Float[Tensor, "3"] | None, most: int) -> tuple[int, int]:
    """Columns and rows of "auto", by photos and points; blocks are about square. (1, 1) where one is enough.

    Args:
        capture: with points.
        up: as of `cut`.
        most: triangles that there may be in a block.
    """
    points = _needed_points(capture)
    needed = max(math.ceil(len(capture.train) / MOST_PHOTOS), math.ceil(len(points) / max(1.0, MOST_POINTS * most)))
    low, high = _extent(points @ _axes(points, up).T)
    aspect = max(float((high - low)[0] / (high - low)[1].clamp_min(1e-12)), 1.0)
    columns = min(needed, max(1, round(math.sqrt(needed * aspect))))
    return columns, math.ceil(needed / columns)


def cut(capture: Dataset, shape: tuple[int, int], up: Float[Tensor, "3"] | None) -> Grid:
    """A grid of so many columns, along the longer side of the ground, and rows.

    Args:
        capture: with points.
        shape: columns and rows.
        up: where up is; None for the direction in which the points are spread least.

    Raises:
        InputError: the capture has no points, or too few.
    """
    points, (columns, rows) = _needed_points(capture), shape
    if len(points) < 10 * columns * rows:
        raise InputError(f"blocks: {columns}x{rows} are too many for {len(points):,} points; choose fewer")
    across = _axes(points, up)
    placed = points @ across.T
    first = _quantiles(placed[:, 0], columns)
    column = torch.searchsorted(first, placed[:, 0].contiguous(), right=True)
    second = torch.stack([_quantiles(placed[column == each, 1], rows) for each in range(columns)])
    return Grid(across, first, second, *_extent(placed))


def covered(capture: Dataset, grid: Grid) -> Float[Tensor, "B K"]:
    """(B, K) what part of each photo each of K blocks covers, by the points that the photo shows; 0 of none."""
    points = _needed_points(capture)
    points = points[:: math.ceil(len(points) / LOOKED_AT)]
    block, points = grid.block_of(points), points.float()
    return torch.stack([_shares(camera, points, block, len(grid)) for camera in capture.cameras])


def views_of(shares: Float[Tensor, "B K"]) -> list[list[int]]:
    """The photos of each block, by index, ascending. Every photo that shows anything belongs to one or more."""
    belongs = shares >= COVERED
    showing = (shares.sum(dim=1) > 0).nonzero()[:, 0]
    belongs[showing, shares[showing].argmax(dim=1)] = True
    return [column.nonzero()[:, 0].tolist() for column in belongs.unbind(dim=1)]


def parts_of(capture: Dataset, grid: Grid) -> list[Dataset]:
    """Each block as a capture of its own: the photos that see it, and its points with those of its margin.

    Raises:
        InputError: too few training photos see a block.
    """
    parts, points = [], _needed_points(capture)
    for block, views in enumerate(views_of(covered(capture, grid))):
        part, near = capture.of_views(views), grid.around(block, points)
        if len(part.train) < FEWEST:
            shape = "x".join(map(str, grid.shape))
            raise InputError(
                f"blocks: {shape}: {len(part.train)} training photos show block {grid.name(block)}; choose fewer blocks"
            )
        colors = None if capture.point_colors is None else capture.point_colors[near]
        parts.append(replace(part, exact_points=points[near], point_colors=colors, notes=()))
    return parts


def _needed_points(capture: Dataset) -> Float[Tensor, "P 3"]:
    if capture.exact_points is None:
        raise InputError(f"blocks: are cut by points, and the capture has none; train it without {option('blocks')}")
    return capture.exact_points


def _axes(points: Float[Tensor, "P 3"], up: Float[Tensor, "3"] | None) -> Float[Tensor, "2 3"]:
    """Of the ground plane: first where points are spread most."""
    spread = torch.linalg.eigh((points - points.mean(dim=0)).T.cov())[1]  # columns by ascending variance
    upright = spread[:, 0] if up is None else torch.nn.functional.normalize(up.double(), dim=0)
    flat = points - points.mean(dim=0)
    flat = flat - (flat @ upright)[:, None] * upright
    first = torch.linalg.eigh(flat.T.cov())[1][:, 2]
    first = torch.nn.functional.normalize(first - (first @ upright) * upright, dim=0)
    first = first * (1.0 if float(first[first.abs().argmax()]) > 0 else -1.0)
    return torch.stack([first, torch.linalg.cross(upright, first)])


def _extent(placed: Float[Tensor, "P 2"]) -> tuple[Float[Tensor, "2"], Float[Tensor, "2"]]:
    ordered = placed.sort(dim=0).values
    low, high = (round(part * (len(ordered) - 1)) for part in ((1 - _EXTENT) / 2, (1 + _EXTENT) / 2))
    return ordered[low], ordered[high]


def _quantiles(values: Float[Tensor, " P"], parts: int) -> Float[Tensor, " P1"]:
    """Between which values equally many lie."""
    ordered = values.sort().values
    return ordered[[len(ordered) * part // parts for part in range(1, parts)]]


def _shares(camera: Cameras, points: Float[Tensor, "P 3"], block: Int[Tensor, " P"], count: int) -> Float[Tensor, " K"]:
    """(K,) of the bins of a photo that have a point, how many each block has the nearest one of."""
    at = points @ camera.viewmats[0, :3, :3].T + camera.viewmats[0, :3, 3]
    x, y, depth = (at @ camera.Ks[0].T).unbind(dim=1)
    inside = (depth > 0) & (x >= 0) & (y >= 0) & (x < camera.width * depth) & (y < camera.height * depth)
    x, y, depth, block = x[inside], y[inside], depth[inside], block[inside]
    if not len(depth):
        return torch.zeros(count)
    columns, rows = (
        (BINS * along / depth / side).long().clamp_max(BINS - 1)
        for along, side in ((x, camera.width), (y, camera.height))
    )
    order = depth.argsort(descending=True, stable=True)
    rank = torch.empty_like(order)
    rank[order] = torch.arange(len(order))
    nearest = torch.full((BINS * BINS,), -1).scatter_reduce(0, rows * BINS + columns, rank, "amax")
    owners = block[order[nearest[nearest >= 0]]]
    return torch.bincount(owners, minlength=count).float() / len(owners)
