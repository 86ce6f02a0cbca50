"""Posed photos, of an object or of a scene: what every loader returns and every run starts from."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.cameras import Cameras, camera_centers
from etsplat.core.errors import InputError
from etsplat.core.precision import usual_defaults
from etsplat.core.short_repr import short_repr
from etsplat.core.validation import check_above, check_count, shown
from etsplat.data.changed_pictures import halved
from etsplat.data.dataset_checks import (
    checked_intrinsics,
    checked_point,
    checked_points,
    checked_split,
    checked_viewmats,
)
from etsplat.data.pictures import Pictures, as_float
from etsplat.io.georeference import Georeference

WATCHED_ONE_IN, WATCHED_FROM = 16, 24
"""One in so many training photos is kept aside to watch runs by, where there are at least so many."""

SPREAD_FACTOR = 1.1
"""Extent = this times the largest distance of a training camera from their mean, as 3DGS has it."""


@dataclass(frozen=True, eq=False)
class Normalization:
    """The similarity between the input's own units and another frame: x_frame = (x - center) / radius.

    Attributes:
        center: (3,) in input units.
        radius: > 0, in input units.

    Raises:
        ValueError: they are no such point and number.

    Example:
        >>> frame = etsplat.Normalization(torch.tensor([1.0, 0.0, 0.0]), radius=2.0)
        >>> frame.invert(frame.apply(torch.tensor([[3.0, 0.0, 0.0]]))).tolist()
        [[3.0, 0.0, 0.0]]
    """

    center: Float[Tensor, "3"] = field(default_factory=lambda: torch.zeros(3, dtype=torch.float64))
    radius: float = 1.0

    def __post_init__(self) -> None:
        check_above("radius", self.radius)
        object.__setattr__(self, "center", checked_point("center", self.center))

    def apply(self, points: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
        """Input units to the frame."""
        return (points - self.center.to(points)) / self.radius

    def invert(self, points: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
        """The frame to input units."""
        return points * self.radius + self.center.to(points)


@dataclass(frozen=True, eq=False)
class Dataset:
    """Posed photos, each with a camera of its own size.

    Poses and points are kept in double precision, so that a scene far from its origin can be moved there without loss;
    `cameras` and `points` give them in the engines' float32. They are measurements: no gradients reach them.

    Attributes:
        viewmats: (B, 4, 4) float64, world to camera, OpenCV axes.
        Ks: (B, 3, 3) float64, in pixels of the photos as loaded.
        images: B photos; `images.sizes` are their (width, height). Where alpha is below 1 a background shows; pixels
            that a mask excludes are ignored.
        names: B names, unique, fit for files.
        train: indices of the views to optimise on, ascending.
        test: indices of the views held out, ascending. Disjoint from `train`.
        exact_points: (P, 3) float64, P > 0, or None.
        point_colors: (P, 3) float32 in [0, 1] as displayed, or None without points.
        normalization: from the input's own units to the present frame.
        watched: indices of the views kept from training to watch runs by, ascending. Disjoint from both.
        notes: sentences about what of the input is left out or not understood.
        georeference: where the input's own units lie in the world; None where nobody said so.

    Raises:
        ValueError: fields that contradict each other; poses that are no rotations; intrinsics with skew; numbers that
            are not finite.

    Example:
        Photos of your own, of an object before nothing, seen by cameras of your own:

        >>> rgba = [torch.zeros(48, 64, 4, dtype=torch.uint8) for _ in range(6)]  # premultiplied
        >>> cameras = etsplat.orbit_cameras(64, 48, elevations=(10.0,), azimuths=6)
        >>> names = [f"photo_{index}" for index in range(6)]
        >>> pictures = etsplat.StoredPictures(rgba)
        >>> len(etsplat.Dataset(cameras.viewmats, cameras.Ks, pictures, names, train=[1, 2, 3, 4, 5], test=[0]))
        6

        >>> photos = etsplat.photograph(etsplat.demo_object(), 16, 16)
        >>> len(photos.train), len(photos.test), photos.images[0].shape
        (32, 8, torch.Size([16, 16, 4]))
    """

    __repr__ = short_repr

    viewmats: Float[Tensor, "B 4 4"]
    Ks: Float[Tensor, "B 3 3"]
    images: Pictures
    names: list[str]
    train: list[int]
    test: list[int]
    exact_points: Float[Tensor, "P 3"] | None = None
    point_colors: Float[Tensor, "P 3"] | None = None
    normalization: Normalization = field(default_factory=Normalization)
    watched: list[int] = field(default_factory=list)
    notes: tuple[str, ...] = ()
    georeference: Georeference | None = None

    @usual_defaults()
    def __post_init__(self) -> None:
        if not isinstance(self.images, Pictures):
            raise ValueError(f"images must be Pictures, got {type(self.images).__name__}: pass StoredPictures(images)")
        fields: dict[str, Any] = {"viewmats": checked_viewmats(self.viewmats), "Ks": checked_intrinsics(self.Ks)}
        B = len(self.viewmats)
        if isinstance(self.names, str) or not isinstance(self.names, Sequence | np.ndarray):
            raise ValueError(f"names: expected a list of {B}, one per viewmat, got {shown(self.names)}")
        for name, count in (("Ks", len(self.Ks)), ("images", len(self.images.sizes)), ("names", len(self.names))):
            if count != B:
                raise ValueError(f"{name}: expected {B}, one per viewmat, got {count}")
        if len(set(self.names)) != B:
            raise ValueError("names: expected another one for each view")
        splits = {name: checked_split(name, getattr(self, name), B) for name in ("train", "test", "watched")}
        split = [index for views in splits.values() for index in views]
        if len(split) != len(set(split)):
            raise ValueError("train, test, watched: expected disjoint indices without repetition")
        if self.exact_points is not None:
            points, colors = checked_points(self.exact_points, self.point_colors)
            fields |= {"exact_points": points, "point_colors": colors}
        fields["names"] = [str(name) for name in self.names]  # of an array too
        for name, value in {**fields, **splits}.items():
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.viewmats)

    @cached_property
    @usual_defaults()
    def cameras(self) -> list[Cameras]:
        """B single cameras in float32."""
        return [
            Cameras(self.viewmats[index : index + 1].float(), self.Ks[index : index + 1].float(), *size)
            for index, size in enumerate(self.images.sizes)
        ]

    @property
    def points(self) -> Float[Tensor, "P 3"] | None:
        """(P, 3) float32 points of structure from motion in the present frame, or None."""
        return None if self.exact_points is None else self.exact_points.float()

    @property
    def centers(self) -> Float[Tensor, "B 3"]:
        """(B, 3) float64 camera positions."""
        return camera_centers(self.viewmats)

    @property
    def extent(self) -> float:
        """1.1 times the largest distance of a training camera from the mean of them; 1 if all are at one place."""
        return self._center_and_extent()[1]

    @property
    def has_masks(self) -> bool:
        """Whether any pixel is not fully opaque, that is, whether an object is separated from its background."""
        return any(bool((as_float(image[..., 3:]) < 1).any()) for image in self.images)

    def fingerprint(self) -> str:
        """A short hash of all that a run depends on: cameras, split, points, names, and the photos and masks."""
        digest = hashlib.sha256()
        split = torch.tensor([*self.train, -1, *self.test, *([-1, *self.watched] if self.watched else [])])
        for tensor in (self.viewmats, self.Ks, split, self.exact_points, self.point_colors):
            if tensor is not None:
                digest.update(str(tuple(tensor.shape)).encode())
                digest.update(tensor.contiguous().numpy().tobytes())
        digest.update(repr((self.names, self.images.sizes)).encode())
        digest.update(self.images.fingerprint())
        return digest.hexdigest()[:16]

    def watching(self, one_in: int | None = None) -> "Dataset":
        """The same with some of the training views kept from training, evenly spread, to watch runs by.

        Args:
            one_in: keeps one in so many; 0 keeps none; None keeps one in 16 where there are 24 or more. A data set that
                has watched views already stays as it is.

        Raises:
            InputError: that would be none, or all.
            ValueError: `one_in` is no whole number.
        """
        one_in = None if one_in is None else check_count("one_in", one_in, least=0)
        count = len(self.train)
        if self.watched or one_in == 0 or (one_in is None and count < WATCHED_FROM):
            return self
        kept = count // (one_in or WATCHED_ONE_IN)
        if not 0 < kept < count:
            raise InputError(
                f"watch: one in {one_in} of {count} training photos would be {'all' if kept else 'none'}; choose a "
                f"number from 2 to {count}, or 0"
            )
        watched = middles_of(self.train, kept)
        return replace(self, train=[index for index in self.train if index not in watched], watched=watched)

    def of_views(self, views: Sequence[int]) -> "Dataset":
        """Some of the views alone, in their order; all else stays. Their photos are kept apart from those of this one.

        Args:
            views: indices, without repetition.

        Raises:
            ValueError: there is no view of such an index.
        """
        views = checked_split("views", views, len(self))
        place = {view: number for number, view in enumerate(views)}
        chosen = list(views)
        return replace(
            self,
            viewmats=self.viewmats[chosen],
            Ks=self.Ks[chosen],
            images=self.images.subset(chosen),
            names=[self.names[view] for view in chosen],
            **{
                split: sorted(place[view] for view in getattr(self, split) if view in place)
                for split in ("train", "test", "watched")
            },
        )

    def halved(self) -> "Dataset":
        """The same views at half the size, each pixel the mean of those it replaces (odd sizes are rounded down)."""
        images = halved(self.images)
        ratios = [
            (width / before[0], height / before[1], 1.0)
            for (width, height), before in zip(images.sizes, self.images.sizes, strict=True)
        ]
        Ks = self.Ks.float() * torch.tensor(ratios)[..., None]
        return replace(self, Ks=Ks.double(), images=images)

    def normalized(self) -> "Dataset":
        """The same views where the training cameras are centred at the origin and the extent is 1.

        `normalization.invert` of the result leads back to the input's own units.
        """
        frame = self.frame
        return self.renormalized(frame.center, frame.radius)

    @property
    def frame(self) -> Normalization:
        """From the present frame to that of `normalized`."""
        return Normalization(*self._center_and_extent())

    def renormalized(self, center: Float[Tensor, "3"] | Sequence[float], radius: float) -> "Dataset":
        """The same views in the frame where the sphere (center, radius) of the present frame is the unit sphere.

        A point maps to x' = (x - center) / radius, so a camera [R | t] becomes [R | (t + R center) / radius]; images
        and intrinsics do not change. Computed in the precision of `center`.

        Args:
            center: (3,), or three numbers.
            radius: > 0.

        Raises:
            ValueError: they are no such point and number.
        """
        check_above("radius", radius)
        center, radius = checked_point("center", center), float(radius)
        viewmats = self.viewmats.clone()
        rotations, translations = viewmats[:, :3, :3].to(center), viewmats[:, :3, 3].to(center)
        viewmats[:, :3, 3] = ((translations + rotations @ center) / radius).double()
        points = None if self.exact_points is None else (self.exact_points - center) / radius
        before = self.normalization
        total = Normalization(before.invert(center), before.radius * radius)
        return replace(self, viewmats=viewmats, exact_points=points, normalization=total)

    def in_input_units(self) -> "Dataset":
        """The same views in the units and axes of the input, as results of `reconstruct` and `train` are.

        Example:
            >>> own = etsplat.photograph(etsplat.demo_object(), 8, 8).in_input_units()
            >>> own.normalization.radius
            1.0
        """
        center, radius = self.normalization.center.double(), self.normalization.radius
        return replace(self.renormalized(-center / radius, 1 / radius), normalization=Normalization())

    def _center_and_extent(self) -> tuple[Float[Tensor, "3"], float]:
        centers = self.centers[self.train or list(range(len(self)))]
        center = centers.mean(dim=0)
        spread = float((centers - center).norm(dim=1).max())
        resolvable = 1e-9 * float(center.abs().max())
        return center, SPREAD_FACTOR * spread if spread > resolvable else 1.0


def middles_of(views: Sequence[int], count: int) -> list[int]:
    """So many of the views, evenly spread: the middles of `count` equal parts."""
    return [views[(2 * part + 1) * len(views) // (2 * count)] for part in range(count)]


def every_eighth(count: int) -> tuple[list[int], list[int]]:
    """(train, test) indices of so many views, sorted by name: every 8th, starting with the first, is test."""
    return [index for index in range(count) if index % 8], list(range(0, count, 8))
