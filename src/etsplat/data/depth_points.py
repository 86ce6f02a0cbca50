"""What else a capture knows of the depths that its maps have: its points, and what other maps show."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from etsplat.data.dataset import Dataset

CELLS, IN_CELL, BEHIND = 32, 8, 1.1
"""Points are hidden where another in the same field is nearer by more than this factor; there are so many fields along
the width, or fewer, so that points are as many in each."""

NEIGHBOURS, SAMPLES = 3, 64
"""Maps are compared with those of so many views beside them, of so many pixels along the width."""

Pairs = tuple[Float[Tensor, " K"], Float[Tensor, " K"]]
"""Depths that are known from elsewhere, and what a map says at the same pixels; positive, in units of the frame."""


def points_on_maps(dataset: Dataset, views: Sequence[int]) -> dict[int, Pairs]:
    """Of each view, which has a depth map, depths of the data set's points that are seen there, and of the map.

    Args:
        dataset: with points.
        views: indices.
    """
    assert dataset.exact_points is not None
    return {view: _seen(dataset, view, dataset.exact_points) for view in views}


def maps_on_maps(dataset: Dataset, views: Sequence[int], unit: float = 1.0) -> dict[int, Pairs]:
    """Of each view, which has a depth map, depths of what its neighbours' maps show, and of its own.

    Maps in another unit than the poses contradict each other here, however right each of them is by itself.

    Args:
        dataset: with depth maps.
        views: indices.
        unit: all maps are multiplied by this first.
    """
    shown = {view: shown_by_map(dataset, view, unit) for view in views}
    forward, centers = dataset.viewmats[list(views), 2, :3], dataset.centers[list(views)]
    reach = (centers - centers.mean(dim=0)).norm(dim=1).max().clamp_min(1e-12)
    apart = torch.cdist(centers, centers) / reach + torch.cdist(forward, forward)
    nearest = apart.argsort(dim=1)[:, 1 : 1 + NEIGHBOURS].tolist()
    return {
        view: _seen(dataset, view, torch.cat([shown[views[other]] for other in others]), unit)
        for view, others in zip(views, nearest, strict=True)
        if others
    }


def shown_by_map(dataset: Dataset, view: int, unit: float = 1.0, samples: int = SAMPLES) -> Float[Tensor, "P 3"]:
    """What a depth map shows, at some of its pixels; float64, in the frame.

    Args:
        dataset: with a depth map of the view.
        view: its index.
        unit: the map is multiplied by this first.
        samples: about so many pixels along the width, twice as many at most.
    """
    said = dataset.images.depth(view)
    assert said is not None
    step = max(1, said.shape[1] // samples)
    depth = said[::step, ::step].double() * unit / dataset.normalization.radius
    rows, columns = depth.nonzero().unbind(dim=1)
    depth = depth[rows, columns]
    return unproject(dataset, view, depth, columns * step + 0.5, rows * step + 0.5)


def _seen(dataset: Dataset, view: int, points: Float[Tensor, "P 3"], unit: float = 1.0) -> Pairs:
    """Of points that no other hides, where the map knows a depth."""
    said = dataset.images.depth(view)
    assert said is not None
    depth, column, row = project(dataset, view, points)
    width, _ = dataset.images.sizes[view]
    inside = framed(dataset, view, depth, column, row)
    depth, column, row = depth[inside], column[inside].long(), row[inside].long()
    cells = min(CELLS, max(1, int((len(depth) / IN_CELL) ** 0.5)))
    cell = (row * cells // width) * cells + column * cells // width
    nearest = torch.full((int(cell.max()) + 1 if len(cell) else 0,), torch.inf, dtype=depth.dtype)
    nearest = nearest.scatter_reduce(0, cell, depth, "amin")
    maps = said[row, column].double() * unit / dataset.normalization.radius
    kept = (maps > 0) & (depth <= BEHIND * nearest[cell])
    return depth[kept], maps[kept]


def project(
    dataset: Dataset, view: int, points: Float[Tensor, "P 3"]
) -> tuple[Float[Tensor, " P"], Float[Tensor, " P"], Float[Tensor, " P"]]:
    """Depths of points in a view, and their columns and rows in pixels of its photo; NaN at depth 0.

    Args:
        dataset: whose view it is.
        view: its index.
        points: (P, 3) float64 in the data set's frame.
    """
    viewmat, K = dataset.viewmats[view], dataset.Ks[view]
    across, down, depth = (points @ viewmat[:3, :3].T + viewmat[:3, 3]).unbind(dim=1)
    return depth, K[0, 0] * across / depth + K[0, 2], K[1, 1] * down / depth + K[1, 2]


def on_map(
    dataset: Dataset, view: int, shown: Float[Tensor, "H W"], points: Float[Tensor, "P 3"]
) -> tuple[Float[Tensor, " P"], Float[Tensor, " P"]]:
    """What a map of a view shows at the pixels of points, 0 out of its frame; and the points' own depths.

    Args:
        dataset: whose view it is.
        view: its index.
        shown: (H, W) of its photo, at any size.
        points: (P, 3) float64 in the data set's frame.
    """
    depth, column, row = located = project(dataset, view, points)
    inside = framed(dataset, view, *located)
    width, height = dataset.images.sizes[view]
    column, row = (
        torch.where(inside, each * (count / side), 0.0).long().clamp_max(count - 1)
        for each, count, side in ((column, shown.shape[1], width), (row, shown.shape[0], height))
    )
    return torch.where(inside, shown[row, column], 0.0), depth


def unproject(
    dataset: Dataset, view: int, depth: Float[Tensor, " P"], column: Float[Tensor, " P"], row: Float[Tensor, " P"]
) -> Float[Tensor, "P 3"]:
    """Points in the data set's frame, float64: what `project` takes.

    Args:
        dataset: whose view it is.
        view: its index.
        depth: (P,) float64.
        column: (P,) of the pixels of the photo, whose middles are at halves.
        row: (P,).
    """
    viewmat, K = dataset.viewmats[view], dataset.Ks[view]
    across = (column - K[0, 2]) / K[0, 0] * depth
    down = (row - K[1, 2]) / K[1, 1] * depth
    return (torch.stack([across, down, depth], dim=1) - viewmat[:3, 3]) @ viewmat[:3, :3]


def framed(
    dataset: Dataset, view: int, depth: Float[Tensor, " P"], column: Float[Tensor, " P"], row: Float[Tensor, " P"]
) -> Bool[Tensor, " P"]:
    """Whether what `project` gives is in the frame of the photo.

    Args:
        dataset: whose view it is.
        view: its index.
        depth: (P,) of `project`.
        column: (P,).
        row: (P,).
    """
    width, height = dataset.images.sizes[view]
    return (depth > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
