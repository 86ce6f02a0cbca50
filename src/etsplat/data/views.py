"""Posed views: what every loader returns and every task starts from."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from etsplat.core.cameras import Cameras


@dataclass(frozen=True)
class Normalization:
    """The similarity between the input's own units and the unit frame: x_unit = (x - center) / radius.

    Attributes:
        center: (3,) in input units.
        radius: > 0, in input units.
    """

    center: Float[Tensor, "3"]
    radius: float

    @staticmethod
    def identity() -> "Normalization":
        """The normalization that changes nothing."""
        return Normalization(torch.zeros(3), 1.0)

    def apply(self, points: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
        """Input units to the unit frame."""
        return (points - self.center.to(points)) / self.radius

    def invert(self, points: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
        """The unit frame to input units."""
        return points * self.radius + self.center.to(points)


@dataclass(frozen=True)
class PosedViews:
    """Images with their cameras, in the unit frame of `normalization`.

    Attributes:
        cameras: B cameras, world-to-camera in the unit frame, OpenCV axes.
        images: (B, H, W, 4) float32 in [0, 1], premultiplied RGBA. Alpha is 1 everywhere where the source has neither
            transparency nor masks (`has_masks` is then False).
        names: B names, unique, for reports and file names.
        train: indices of the views to optimise on, ascending.
        test: indices of the views held out, ascending. Disjoint from `train`.
        normalization: from input units to the frame of `cameras`.
    """

    cameras: Cameras
    images: Float[Tensor, "B H W 4"]
    names: list[str]
    train: list[int]
    test: list[int]
    normalization: Normalization

    def __post_init__(self) -> None:
        B = len(self.cameras)
        expected = (B, self.cameras.height, self.cameras.width, 4)
        if tuple(self.images.shape) != expected:
            raise ValueError(f"images: expected shape {expected} to match the cameras, got {tuple(self.images.shape)}")
        if len(self.names) != B:
            raise ValueError(f"names: expected {B}, one per camera, got {len(self.names)}")
        if sorted([*self.train, *self.test]) != sorted(set(self.train) | set(self.test)):
            raise ValueError("train, test: expected disjoint indices without repetition")
        if not all(0 <= index < B for index in [*self.train, *self.test]):
            raise ValueError(f"train, test: expected indices in [0, {B})")

    def __len__(self) -> int:
        return len(self.cameras)

    @property
    def has_masks(self) -> bool:
        """Whether any pixel is not fully opaque, that is, whether the object is separated from its background."""
        return any(bool((image[..., 3] < 1).any()) for image in self.images)

    def halved(self) -> "PosedViews":
        """The same views at half the size, each pixel the mean of those it replaces (odd sizes are rounded down)."""
        cameras = self.cameras
        width, height = max(1, cameras.width // 2), max(1, cameras.height // 2)
        images = self.images.new_empty(len(self), height, width, 4)
        for index, image in enumerate(self.images):  # one by one: a copy of all views in another layout is large
            images[index] = interpolate(image.movedim(-1, 0)[None], (height, width), mode="area")[0].movedim(0, -1)
        Ks = cameras.Ks.clone()
        Ks[:, 0] *= width / cameras.width
        Ks[:, 1] *= height / cameras.height
        return replace(self, cameras=replace(cameras, Ks=Ks, width=width, height=height), images=images)

    def to(self, device: torch.device) -> "PosedViews":
        """The same views with cameras and images on another device."""
        return replace(self, cameras=self.cameras.to(device), images=self.images.to(device))

    def renormalized(self, center: Float[Tensor, "3"], radius: float) -> "PosedViews":
        """The same views in the frame where the sphere (center, radius) of the present frame is the unit sphere.

        A point maps to x' = (x - center) / radius, so a camera [R | t] becomes [R | (t + R center) / radius]; images
        and intrinsics do not change.
        """
        viewmats = self.cameras.viewmats.clone()
        rotations, translations = viewmats[:, :3, :3], viewmats[:, :3, 3]
        viewmats[:, :3, 3] = (translations + rotations @ center.to(viewmats)) / radius
        total = Normalization(self.normalization.invert(center), self.normalization.radius * radius)
        return replace(self, cameras=replace(self.cameras, viewmats=viewmats), normalization=total)


def every_eighth(names: Sequence[str]) -> tuple[list[int], list[int]]:
    """(train, test) indices of names that are already sorted: every 8th, starting with the first, is test."""
    test = list(range(0, len(names), 8))
    return [index for index in range(len(names)) if index % 8], test
