"""Small groups of triangles that stand alone, away from everything else."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from torch import Tensor

from etsplat.core.validation import check_shape
from etsplat.geometry.distance import closest_points

NEIGHBOURS = 8
"""Each triangle is compared with as many others, those with the nearest centroids."""

FEW = 20
"""A group of more triangles than this is taken for part of the scene, wherever it is."""

REACH = 1.5
"""Neighbours are of one group if their centroids are no farther apart than this times the smaller one's radius, the
distance of its farthest corner from its centroid: enough for those with a corner in common in any regular mesh."""


def standing_alone(vertices: Float[Tensor, "N 3 3"], few: int = FEW) -> Bool[Tensor, " N"]:
    """Which triangles belong to a small group that is farther from all large groups than it is large.

    What a group is says `REACH`. The distance of a small group is that of its corners and centroids from the surface of
    all large ones, its size the largest distance of a corner from the mean of its centroids. Where no group is large,
    the largest one is. Where most triangles are in small groups, there is nothing to be away from: none is alone.

    Args:
        vertices: (N, 3, 3) finite corners, on any device.
        few: groups of at most so many triangles are small.

    Returns:
        (N,) on the CPU.
    """
    check_shape("vertices", vertices, ("N", 3, 3))
    corners = vertices.detach().cpu().double()
    if len(corners) < 2:
        return torch.zeros(len(corners), dtype=torch.bool)
    group = _groups(corners)
    count = torch.bincount(group)
    small = count <= min(few, int(count.max()) - 1)
    alone = torch.zeros(len(count), dtype=torch.bool)
    within = small[group]
    if 0 < int(within.sum()) <= len(corners) / 2:
        distance, size = _distances(corners, group, within), _sizes(corners, group)
        alone = small & (distance > size)
    return alone[group]


def _groups(corners: Float[Tensor, "N 3 3"]) -> Int[Tensor, " N"]:
    """The number of each triangle's group."""
    centroids = corners.mean(dim=1)
    radius = (corners - centroids[:, None]).norm(dim=2).amax(dim=1).numpy()
    neighbours = min(NEIGHBOURS + 1, len(corners))  # the first is mostly the triangle itself
    found = KDTree(centroids.numpy()).query(centroids.numpy(), k=neighbours)
    distance, index = (np.asarray(table).reshape(len(corners), neighbours) for table in found)
    meets = distance <= REACH * np.minimum(radius[:, None], radius[index])
    rows = np.broadcast_to(np.arange(len(corners))[:, None], index.shape)
    pairs = coo_matrix((np.ones(int(meets.sum())), (rows[meets], index[meets])), shape=(len(corners),) * 2)
    return torch.from_numpy(connected_components(pairs, directed=False)[1].astype(np.int64))


def _sizes(corners: Float[Tensor, "N 3 3"], group: Int[Tensor, " N"]) -> Float[Tensor, " G"]:
    """Of each group, the largest distance of a corner from the mean of its centroids."""
    groups = int(group.max()) + 1
    total = torch.zeros(groups, 3, dtype=torch.float64).index_add(0, group, corners.mean(dim=1))
    middle = total / torch.bincount(group)[:, None]
    reach = (corners - middle[group][:, None]).norm(dim=2).amax(dim=1)
    return torch.zeros(groups, dtype=torch.float64).scatter_reduce(0, group, reach, "amax")


def _distances(
    corners: Float[Tensor, "N 3 3"], group: Int[Tensor, " N"], within: Bool[Tensor, " N"]
) -> Float[Tensor, " G"]:
    """Of each small group, the least distance to the others' surface; infinity of large ones.

    Args:
        corners: of all triangles.
        group: of each.
        within: which are of small groups.
    """
    others, own = corners[~within], corners[within]
    points = torch.cat([own, own.mean(dim=1, keepdim=True)], dim=1)
    faces = torch.arange(3 * len(others)).reshape(-1, 3)
    squared, _ = closest_points(points.reshape(-1, 3), others.reshape(-1, 3), faces)
    nearest = squared.reshape(len(own), 4).amin(dim=1).sqrt()
    found = torch.full((int(group.max()) + 1,), torch.inf, dtype=torch.float64)
    return found.scatter_reduce(0, group[within], nearest, "amin")
