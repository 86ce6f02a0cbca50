"""What the photos of a capture look at: which of them frame a point or a triangle, and the region in their middle."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.data.dataset import Dataset
from etsplat.geometry.regions import Sphere

OFTEN = 0.5
"""What at least this part of the photos frames that frame what is framed most is what they look at."""

_MOST, _NEARLY_ALL, _MARGIN = 0.98, 0.95, 1.1


def middle_photo(capture: Dataset) -> int:
    """The training photo that was taken nearest to the middle of all of them."""
    centers = capture.centers[capture.train]
    return capture.train[int((centers - centers.mean(dim=0)).norm(dim=1).argmin())]


def frames_around(capture: Dataset, points: Float[Tensor, "P 3"]) -> Int[Tensor, " P"]:
    """How many training photos have each point in their frame, whether or not something hides it.

    Args:
        capture: its training views.
        points: in the frame of the capture.
    """
    count = torch.zeros(len(points), dtype=torch.int64)
    for index in capture.train:
        count += ~_beyond(capture.cameras[index], points[:, None]).any(dim=2)[:, 0]
    return count


def out_of_every_frame(capture: Dataset, vertices: Float[Tensor, "N 3 3"], near_plane: float) -> Bool[Tensor, " N"]:
    """Which triangles lie wholly beyond one side of every training photo's frame, or nearer than the near plane.

    A triangle that passes by a corner of a frame may be counted as inside: none is called outside that is not.

    Args:
        capture: its training views.
        vertices: corners in the frame of the capture.
        near_plane: the least depth at which a camera sees anything.

    Returns:
        (N,) on the device of the vertices.
    """
    outside = torch.ones(len(vertices), dtype=torch.bool, device=vertices.device)
    for index in capture.train:
        camera = capture.cameras[index].to(vertices.device)
        left = outside.nonzero()[:, 0]  # what a photo before this one shows is settled
        outside[left] = _beyond(camera, vertices[left], near_plane).all(dim=1).any(dim=1)
    return outside


def looked_at(capture: Dataset, points: Float[Tensor, "P 3"]) -> Sphere:
    """The sphere around what the training photos look at.

    Around those points that half as many photos frame, or more, as frame those framed most: in captures that go around
    something it is that and what stands beside it; where all cameras look the same way, it is nearly everything. Its
    middle is their median along each axis, and it holds 95 % of them, with a margin of a tenth.

    Args:
        capture: its cameras.
        points: of the surface of the scene, at least one, in the frame of the capture.
    """
    points = points.double()
    count = frames_around(capture, points.float()).double()
    chosen = points[count >= max(1.0, OFTEN * float(_quantile(count, _MOST)))]
    chosen = points if not len(chosen) else chosen
    middle = chosen.median(dim=0).values
    radius = _MARGIN * float(_quantile((chosen - middle).norm(dim=1), _NEARLY_ALL))
    x, y, z = middle.tolist()
    return Sphere((x, y, z), max(radius, 1e-9))


def _beyond(camera: Cameras, points: Float[Tensor, "N K 3"], near_plane: float = 0.0) -> Bool[Tensor, "N K 5"]:
    """Beyond which of the five planes each point lies: near, left, right, top, bottom."""
    at = points @ camera.viewmats[0, :3, :3].T + camera.viewmats[0, :3, 3]
    x, y, w = (at @ camera.Ks[0].T).unbind(dim=-1)  # a pixel is (x / w, y / w), w the depth
    sides = (w <= near_plane, x < 0, x > camera.width * w, y < 0, y > camera.height * w)
    return torch.stack(sides, dim=-1)


def _quantile(values: Float[Tensor, " N"], part: float) -> Float[Tensor, ""]:
    """As `torch.quantile`, of the nearest value, of any number of them."""
    return values.sort().values[round(part * (len(values) - 1))]
