"""What lies behind everything in a capture: a closed sphere of triangles, coloured by the photos.

Photos of few views leave gaps between what they show. Without anything behind them a gap is a hole, and the background
of a photo is learned by triangles in the air before its camera, where no other view expects them.
"""

import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from etsplat.geometry.icosphere import icosphere
from etsplat.scene.captures import Capture
from etsplat.scene.triangle_soup import TriangleSoup

LEVEL = 3
SPHERE_TRIANGLES = 20 * 4**LEVEL
"""Subdivisions of the sphere, and its triangles: 1,280, each about eight degrees wide."""

OPACITY, SIGMA = 0.98, 0.4
"""Opaque, and sharp enough that nothing shines through at the start; much sharper ones would be the parents of most
children."""

REACH = 1.5
"""Radius of the sphere, relative to the distance within which nearly all points lie."""

_NEARLY_ALL = 0.98
_BLENDED = 8


def surroundings(capture: Capture, sh_degree: int) -> TriangleSoup:
    """The sphere around the cameras and nearly all points.

    A triangle has the mean colour of the photos at its centroid. One that no photo shows gets the colours of those
    nearest to it that one shows.

    Args:
        capture: its training views are looked at.
        sh_degree: of the colours.
    """
    centers = capture.centers[capture.train].float()
    middle = centers.mean(dim=0)
    everything = centers if capture.points is None else torch.cat([centers, capture.points])
    radius = REACH * float((everything - middle).norm(dim=1).quantile(_NEARLY_ALL))
    directions, faces = icosphere(LEVEL)
    corners = middle + radius * directions[faces]
    colors, seen = _photographed(capture, corners.mean(dim=1))
    if bool(seen.any()) and not bool(seen.all()):
        towards = directions[faces].mean(dim=1)
        distance, nearest = KDTree(towards[seen].numpy()).query(
            towards[~seen].numpy(), k=min(_BLENDED, int(seen.sum()))
        )
        distance, nearest = torch.from_numpy(distance).float(), torch.from_numpy(nearest)
        weight = (1 / distance.clamp_min(1e-6)).reshape(len(towards[~seen]), -1, 1)
        near = colors[seen][nearest].reshape(len(weight), -1, 3)
        colors[~seen] = (weight * near).sum(dim=1) / weight.sum(dim=1)
    return TriangleSoup.from_triangles(corners, colors, opacity=OPACITY, sigma=SIGMA, sh_degree=sh_degree)


def _photographed(capture: Capture, positions: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "N 3"], Tensor]:
    """Mean colour of the training photos at each position, grey where none shows it; and whether one does."""
    total, count = torch.zeros_like(positions), torch.zeros(len(positions), 1)
    for view in capture.train:
        camera, photo = capture.cameras[view], capture.images[view]
        at = positions @ camera.viewmats[0, :3, :3].T + camera.viewmats[0, :3, 3]
        pixel = (at / at[:, 2:].clamp_min(1e-6)) @ camera.Ks[0].T
        inside = (at[:, 2] > 0) & (pixel[:, :2] >= 0).all(dim=1)
        inside &= (pixel[:, 0] < camera.width) & (pixel[:, 1] < camera.height)
        x, y = pixel[inside, :2].long().unbind(dim=1)
        total[inside] += photo[y, x, :3].float() / 255
        count[inside] += 1
    return torch.where(count > 0, total / count.clamp_min(1), 0.5), count[:, 0] > 0
