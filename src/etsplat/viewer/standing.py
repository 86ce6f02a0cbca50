"""Where the viewer's cameras stand: at photos, and near them, where there is something to see."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.data.camera_coverage import focus_point
from etsplat.data.dataset import Dataset
from etsplat.data.where_up import up_of
from etsplat.model.triangle_soup import TriangleSoup

FRUSTUM = 0.04
"""Size of the pictured cameras, relative to the scene's extent."""

_MARGIN = 0.25
"""How far from photos one may stand, relative to how far these are from what they show."""

_SPACING = 0.6
"""And at least so many times the usual distance between neighbours, so that there is a way from each to the next."""


@dataclass(frozen=True)
class Neighbourhood:
    """The places that are near photos.

    Attributes:
        centers: (B, 3) float64, where photos were taken.
        margin: how far from the nearest of them a place may be.
    """

    centers: Float[Tensor, "B 3"]
    margin: float

    @classmethod
    def of(cls, capture: Dataset) -> "Neighbourhood":
        """That of a capture's training photos."""
        centers = capture.centers[capture.train]
        away = float((centers - focus_point(capture.viewmats[capture.train])).norm(dim=1).median())
        some = centers[torch.linspace(0, len(centers) - 1, min(len(centers), 400)).round().long()]
        apart = torch.cdist(some, some).fill_diagonal_(torch.inf).min(dim=1).values.median()
        spacing = float(apart) if len(some) > 1 else 0.0
        return cls(centers, max(_MARGIN * away, _SPACING * spacing, 1e-9))

    def nearest(self, position: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
        """The position itself where it is near a photo; else the place on the way to the nearest one that is."""
        offsets = position.double() - self.centers
        distances = offsets.norm(dim=1)
        photo = int(distances.argmin())
        if float(distances[photo]) <= 1.001 * self.margin:  # as it is after float32
            return position.double()
        return self.centers[photo] + offsets[photo] * (self.margin / distances[photo])

    def kept(self, camera: Cameras) -> Cameras:
        """A single camera, moved to the nearest place without being turned."""
        position = camera.centers[0].double()
        near = self.nearest(position)
        if torch.equal(near, position):
            return camera
        viewmats = camera.viewmats.clone()
        viewmats[0, :3, 3] = -(viewmats[0, :3, :3].double() @ near).to(viewmats)
        return replace(camera, viewmats=viewmats)


def nearest_photo(capture: Dataset, camera: Cameras) -> int:
    """The photo that was taken from where a single camera stands, looking where it looks, or most nearly so."""
    offsets = (capture.centers - camera.centers[0].double()).norm(dim=1) / capture.extent
    turned = 1 - capture.viewmats[:, 2, :3] @ camera.viewmats[0, 2, :3].double()
    candidates = torch.tensor(sorted([*capture.train, *capture.test, *capture.watched]))
    return int(candidates[(offsets + turned)[candidates].argmin()])


def fov_of(capture: Dataset, index: int) -> float:
    """Vertical field of view of a photo, in radians."""
    return 2 * float(torch.atan(capture.images.sizes[index][1] / (2 * capture.Ks[index, 1, 1])))


def stand_at(client: Any, capture: Dataset, index: int) -> None:
    """Takes a browser to a photo's camera."""
    position = capture.centers[index]
    forward = capture.viewmats[index, 2, :3]
    # The point to turn about: on the line of sight, beside what all cameras look at.
    distance = float(((focus_point(capture.viewmats) - position) @ forward).clamp_min(0.05 * capture.extent))
    up = up_of(capture)
    with client.atomic():
        client.camera.up_direction = (-capture.viewmats[index, 1, :3] if up is None else up).numpy()
        client.camera.position = position.numpy()
        client.camera.look_at = (position + distance * forward).numpy()
        client.camera.fov = fov_of(capture, index)


def stand_before(client: Any, soup: TriangleSoup) -> None:
    """Without cameras: far enough away to see nine tenths of the triangles."""
    centers = soup.vertices.detach().mean(dim=1).cpu()
    middle = centers.median(dim=0).values
    distance = 2.5 * float(torch.quantile((centers - middle).norm(dim=1)[:1_000_000], 0.9))
    with client.atomic():
        client.camera.position = (middle + torch.tensor([0.3, 0.3, 0.9]) * distance).numpy()
        client.camera.look_at = middle.numpy()


def add_frusta(server: Any, capture: Dataset) -> list[Any]:
    """A pyramid for every training camera, hidden; a click on one goes there."""
    rotations = capture.viewmats[:, :3, :3].mT
    frusta = []
    for index in capture.train:
        width, height = capture.images.sizes[index]
        frustum = server.scene.add_camera_frustum(
            f"/cameras/{capture.names[index]}",
            fov=fov_of(capture, index),
            aspect=width / height,
            scale=FRUSTUM * capture.extent,
            color=(230, 120, 40),
            wxyz=quaternion(rotations[index]),
            position=capture.centers[index].numpy(),
            visible=False,
        )

        def go(event: Any, index: int = index) -> None:
            stand_at(event.client, capture, index)

        frustum.on_click(go)
        frusta.append(frustum)
    return frusta


def quaternion(rotation: torch.Tensor) -> np.ndarray:
    """(w, x, y, z) of a rotation matrix."""
    x, y, z, w = Rotation.from_matrix(rotation.numpy()).as_quat()
    return np.array([w, x, y, z])
