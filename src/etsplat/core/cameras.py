"""Pinhole cameras: world-to-camera matrices with OpenCV axes and intrinsics in pixels (docs/conventions.md)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.precision import as_given
from etsplat.core.short_repr import short_repr
from etsplat.core.validation import (
    check_above,
    check_count,
    check_finite,
    check_floating,
    check_kind,
    check_like,
    check_memory,
    check_number,
    check_place,
    check_shape,
    whole_number,
)

MAX_SIDE = 1 << 26
"""Pixels of the width or height of an image: with 16 samples in each they can still be numbered in 32 bits."""

MAX_PIXELS = 1 << 31
"""Of one image: a colour and alpha of each take 34 GB."""


@dataclass(frozen=True, eq=False)
class Cameras:
    """B pinhole cameras with one image size.

    Attributes:
        viewmats: (B, 4, 4) world to camera; x right, y down, z forward.
        Ks: (B, 3, 3) intrinsics in pixels; pixel (i, j) has its centre at (j + 0.5, i + 0.5).
        width: Image width in pixels.
        height: Image height in pixels.

    Raises:
        ValueError: A wrong shape or dtype, a width or height that is no whole number from 1 to 2^26, or more than 2^31
            pixels.

    Example:
        >>> around = etsplat.orbit_cameras(64, 48, elevations=(0.0, 30.0), azimuths=4)
        >>> len(around), around.viewmats.shape
        (8, torch.Size([8, 4, 4]))
        >>> around[2].width  # one of them, or a slice
        64
    """

    __repr__ = short_repr

    viewmats: Float[Tensor, "B 4 4"]
    Ks: Float[Tensor, "B 3 3"]
    width: int
    height: int

    def __post_init__(self) -> None:
        for name, tensor in (("viewmats", self.viewmats), ("Ks", self.Ks)):
            check_memory(name, tensor)
            check_floating(name, tensor)
        batch = self.viewmats.shape[0] if self.viewmats.ndim == 3 else -1
        if self.viewmats.shape != (batch, 4, 4):
            raise ValueError(f"viewmats must have shape (B, 4, 4), got {tuple(self.viewmats.shape)}")
        if self.Ks.shape != (batch, 3, 3):
            raise ValueError(f"Ks must have shape ({batch}, 3, 3), one per viewmat, got {tuple(self.Ks.shape)}")
        for name, side in zip(("width", "height"), check_size(self.width, self.height), strict=True):
            object.__setattr__(self, name, side)

    def __len__(self) -> int:
        return self.viewmats.shape[0]

    def __getitem__(self, index: int | slice | Sequence[int] | Tensor) -> "Cameras":
        """The chosen cameras, always as a batch: an int gives a batch of one.

        Args:
            index: One, a slice, several, or a mask of all.

        Raises:
            IndexError: There is no camera of that index.
        """
        one = whole_number(index)
        if one is not None and not -len(self) <= one < len(self):
            raise IndexError(f"index of a camera must be below {len(self)}, as there are so many, got {one}")
        several = list(index) if isinstance(index, tuple) else index  # torch takes a tuple as one index for each axis
        chosen = several if one is None else [one]
        return Cameras(self.viewmats[chosen], self.Ks[chosen], self.width, self.height)

    @property
    def centers(self) -> Float[Tensor, "B 3"]:
        """Camera positions in world space."""
        return camera_centers(self.viewmats)

    @staticmethod
    def stacked(cameras: Sequence["Cameras"]) -> "Cameras":
        """Cameras of one size as a batch. Raises ValueError where there are none, or where sizes differ."""
        for index, camera in enumerate(cameras):
            check_kind(f"cameras[{index}]", camera, Cameras)
        if not cameras:
            raise ValueError("cameras: expected at least one, got none")
        sizes = {(camera.width, camera.height) for camera in cameras}
        if len(sizes) != 1:
            raise ValueError(f"cameras: expected images of one size, got {sorted(sizes)}")
        viewmats, Ks = ([getattr(camera, name) for camera in cameras] for name in ("viewmats", "Ks"))
        return Cameras(torch.cat(viewmats), torch.cat(Ks), *sizes.pop())

    def scaled(self, factor: float) -> "Cameras":
        """The same cameras with images ``factor`` times as large, rounded to whole pixels (at least one).

        Raises:
            ValueError: ``factor`` is not positive and finite, or the images become too large.
        """
        check_above("factor", factor)
        factor = float(factor)
        width, height = max(1, round(self.width * factor)), max(1, round(self.height * factor))
        ratios = [width / self.width, height / self.height, 1.0]
        ratio = torch.tensor(ratios, dtype=self.Ks.dtype, device=self.Ks.device)
        return Cameras(self.viewmats, self.Ks * ratio[:, None], width, height)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> "Cameras":
        """The same cameras on another device or in another precision. Raises ValueError where `device` is a dtype."""
        check_place(device)
        return Cameras(
            self.viewmats.to(device=device, dtype=dtype),
            self.Ks.to(device=device, dtype=dtype),
            self.width,
            self.height,
        )


def check_size(width: object, height: object) -> tuple[int, int]:
    """Both as ints; ValueError unless they are whole numbers, from 1 to `MAX_SIDE`, of no more than `MAX_PIXELS`."""
    columns, rows = check_count("width", width, most=MAX_SIDE), check_count("height", height, most=MAX_SIDE)
    if columns * rows > MAX_PIXELS:
        raise ValueError(
            f"width and height must be of at most {MAX_PIXELS} pixels together, got {columns} x {rows}: draw it in "
            "parts, each with its principal point, cx and cy of Ks, moved by where it begins"
        )
    return columns, rows


def check_cameras(cameras: object, like_name: str, like: Tensor) -> None:
    """Raise ValueError unless they are `Cameras` of the dtype and on the device of ``like``."""
    if not isinstance(cameras, Cameras):
        raise ValueError(f"cameras must be Cameras, got {_made(cameras)}")
    for wanted, got in ((like.dtype, cameras.viewmats.dtype), (like.device, cameras.viewmats.device)):
        if got != wanted:
            here = f"cameras.to({like_name}.device, {like_name}.dtype)"
            raise ValueError(f"cameras must be {wanted} like {like_name}, got {got}: pass {here}")


@as_given
def camera_centers(viewmats: Float[Tensor, "B 4 4"]) -> Float[Tensor, "B 3"]:
    """Positions of cameras in world space, -R^T t."""
    return -torch.einsum("bji,bj->bi", viewmats[:, :3, :3], viewmats[:, :3, 3])


def _made(cameras: object) -> str:
    """What is no `Cameras`, and how these are made."""
    if isinstance(cameras, list | tuple) and any(isinstance(camera, Cameras) for camera in cameras):
        return f"{type(cameras).__name__} of them: pass etsplat.Cameras.stacked(cameras), or one after the other"
    return f"{type(cameras).__name__}: make them by etsplat.Cameras(viewmats, Ks, width, height)"


def view_arguments(
    cameras: Cameras | None,
    viewmats: Float[Tensor, "B 4 4"] | None,
    Ks: Float[Tensor, "B 3 3"] | None,
    width: int | None,
    height: int | None,
) -> tuple[Float[Tensor, "B 4 4"], Float[Tensor, "B 3 3"], int, int]:
    """What a drawing function was given to look from: ``cameras``, or the four others.

    Raises:
        ValueError: Both, neither or only some of the four are given; a size that is none of an image.
    """
    if cameras is None:
        if viewmats is None or Ks is None or width is None or height is None:
            raise ValueError("either cameras, or all of viewmats, Ks, width and height must be given")
        return viewmats, Ks, *check_size(width, height)
    if not isinstance(cameras, Cameras):
        raise ValueError(f"cameras must be Cameras, got {_made(cameras)}")
    if any(given is not None for given in (viewmats, Ks, width, height)):
        raise ValueError("either cameras, or all of viewmats, Ks, width and height must be given, not some of both")
    return cameras.viewmats, cameras.Ks, cameras.width, cameras.height


def check_views(viewmats: Tensor, Ks: Tensor, like_name: str, like: Tensor) -> None:
    """Raise ValueError unless they are tensors of the shapes (B, 4, 4) and (B, 3, 3), and like ``like``."""
    check_shape("viewmats", viewmats, ("B", 4, 4))
    check_shape("Ks", Ks, (len(viewmats), 3, 3))
    check_like("viewmats", viewmats, like_name, like)
    check_like("Ks", Ks, like_name, like)


@as_given
def look_at(
    eye: Float[Tensor, "*batch 3"], target: Float[Tensor, "*#batch 3"], up: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*batch 4 4"]:
    """World-to-camera matrices of cameras at ``eye`` that look at ``target``.

    Args:
        eye: (..., 3) camera positions.
        target: (..., 3) or (3,) points that land on the optical axis.
        up: (..., 3) or (3,) directions that point up in the image; any length.

    Returns:
        (..., 4, 4) with OpenCV axes.

    Raises:
        ValueError: A wrong shape or dtype; values that are not finite; ``eye`` coincides with ``target``, or ``up`` is
            parallel to the line of sight.

    Example:
        >>> eye = torch.tensor([0.0, 0.0, 3.0])
        >>> viewmat = etsplat.look_at(eye, target=torch.zeros(3), up=torch.tensor([0.0, 1.0, 0.0]))
        >>> (viewmat @ torch.tensor([0.0, 0.0, 0.0, 1.0])).tolist()[2]  # the target is three units ahead
        3.0
    """
    check_memory("eye", eye)
    check_floating("eye", eye)
    if eye.shape[-1:] != (3,):
        raise ValueError(f"eye must have shape (..., 3), got {tuple(eye.shape)}")
    target = _like_eye("target", target, eye)
    forward = target - eye
    distance = forward.norm(dim=-1, keepdim=True)
    if not bool((distance > 0).all()):
        _check_finite(eye=eye, target=target)
        raise ValueError("eye must differ from target")
    forward = forward / distance
    up = _like_eye("up", up, eye).expand_as(forward)
    right = torch.linalg.cross(forward, up / up.norm(dim=-1, keepdim=True))
    length = right.norm(dim=-1, keepdim=True)
    if not bool((length > 1e-6).all()):
        _check_finite(eye=eye, target=target, up=up)
        raise ValueError("up must not be parallel to the line of sight from eye to target")
    right = right / length
    down = torch.linalg.cross(forward, right)
    rotation = torch.stack([right, down, forward], dim=-2)
    viewmats = torch.zeros(*eye.shape[:-1], 4, 4, dtype=eye.dtype, device=eye.device)
    viewmats[..., :3, :3] = rotation
    viewmats[..., :3, 3] = -(rotation @ eye[..., None])[..., 0]
    viewmats[..., 3, 3] = 1.0
    return viewmats


def _check_finite(**points: Tensor) -> None:
    for name, tensor in points.items():
        check_finite(name, tensor.detach())


def _like_eye(name: str, given: Tensor | Sequence[float], eye: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*#batch 3"]:
    """A tensor, or a tuple of numbers, in the precision and on the device of ``eye``."""
    if isinstance(given, Tensor):
        check_memory(name, given)
    try:
        points = torch.as_tensor(given, dtype=eye.dtype, device=eye.device)
    except (TypeError, ValueError, RuntimeError) as error:  # torch's own, depending on what it is
        raise ValueError(f"{name} must be a tensor or three numbers, got {given!r}") from error
    fits = points.ndim <= eye.ndim and all(
        n in (1, m) for n, m in zip(points.shape[::-1], eye.shape[::-1], strict=False)
    )
    if points.shape[-1:] != (3,) or not fits:
        raise ValueError(f"{name} must have shape (3,) or that of eye, {tuple(eye.shape)}, got {tuple(points.shape)}")
    return points


def intrinsics(
    fov_y_degrees: float, width: int, height: int, dtype: torch.dtype = torch.float32
) -> Float[Tensor, "3 3"]:
    """Intrinsics of a camera with square pixels and a centred principal point.

    Args:
        fov_y_degrees: Vertical field of view in degrees, between 0 and 180.
        width: Image width in pixels.
        height: Image height in pixels.
        dtype: Floating-point type of the result.

    Raises:
        ValueError: The field of view is outside (0, 180), or the size is none of an image.

    Example:
        >>> etsplat.intrinsics(90.0, 200, 100).tolist()
        [[50.0, 0.0, 100.0], [0.0, 50.0, 50.0], [0.0, 0.0, 1.0]]
    """
    width, height = check_size(width, height)
    check_number("fov_y_degrees", fov_y_degrees)
    if not 0.0 < fov_y_degrees < 180.0:
        raise ValueError(f"fov_y_degrees must be between 0 and 180, got {fov_y_degrees}")
    focal = 0.5 * height / math.tan(math.radians(fov_y_degrees) / 2)
    return torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]], dtype=dtype)


def sphere_grid(
    elevations: Sequence[float], azimuths: Sequence[float], distance: float, dtype: torch.dtype = torch.float32
) -> Float[Tensor, "B 3"]:
    """Points on a sphere about the origin, for ``look_at(points, origin, up=(0, 1, 0))``.

    Args:
        elevations: Degrees above the xz-plane, +90 on +y.
        azimuths: Degrees about +y; 0 is on +z, 90 on +x.
        distance: Radius of the sphere.
        dtype: Floating-point type of the result.

    Returns:
        (len(elevations) * len(azimuths), 3); the azimuth varies fastest.

    Raises:
        ValueError: ``distance`` is no number.

    Example:
        >>> etsplat.sphere_grid([0.0], [0.0, 90.0], distance=2.0).round(decimals=4).abs().tolist()
        [[0.0, 0.0, 2.0], [2.0, 0.0, 0.0]]
    """
    check_number("distance", distance)
    elevation, azimuth = torch.meshgrid(
        torch.deg2rad(torch.as_tensor(elevations, dtype=torch.float64)),
        torch.deg2rad(torch.as_tensor(azimuths, dtype=torch.float64)),
        indexing="ij",
    )
    points = torch.stack(
        [elevation.cos() * azimuth.sin(), elevation.sin(), elevation.cos() * azimuth.cos()], dim=-1
    ).reshape(-1, 3)
    return (distance * points).to(dtype)
