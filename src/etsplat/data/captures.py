"""Captures for novel-view synthesis: cameras of any size, 8-bit images, points, split and the frame they are in."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.data.capture_images import CaptureImages, StoredImages
from etsplat.data.frames import FrameSet, check_count, scaled_intrinsics
from etsplat.data.load import read_scene
from etsplat.data.views import Normalization
from etsplat.io.images import image_size
from etsplat.io.memory import available_memory

MAX_WIDTH = 1600
"""Wider images are shrunk to this width unless another is asked for, as 3DGS does."""

SPREAD_FACTOR = 1.1
"""Scene extent = this times the largest distance of a training camera from their mean, as 3DGS has it."""


@dataclass(frozen=True)
class Capture:
    """Posed photos of a scene, each with a camera of its own size.

    Poses and points are kept in double precision, so that a scene far from its origin can be moved there without loss;
    `cameras` and `points` give them in the engine's float32.

    Attributes:
        viewmats: (B, 4, 4) float64, world to camera, OpenCV axes.
        Ks: (B, 3, 3) float64, in pixels of the images as loaded.
        images: B images of 8 bits per channel; `images.sizes` are their (width, height).
        names: B names, unique, fit for files.
        train: indices of the views to optimise on, ascending.
        test: indices of the views held out, ascending.
        exact_points: (P, 3) float64, P > 0, or None.
        point_colors: (P, 3) float32 in [0, 1] as displayed, or None without points.
        normalization: from the capture's own units to the present frame.
    """

    viewmats: Float[Tensor, "B 4 4"]
    Ks: Float[Tensor, "B 3 3"]
    images: CaptureImages | StoredImages
    names: list[str]
    train: list[int]
    test: list[int]
    exact_points: Float[Tensor, "P 3"] | None
    point_colors: Float[Tensor, "P 3"] | None
    normalization: Normalization

    def __len__(self) -> int:
        return len(self.viewmats)

    @property
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
        return -torch.einsum("bji,bj->bi", self.viewmats[:, :3, :3], self.viewmats[:, :3, 3])

    @property
    def extent(self) -> float:
        """1.1 times the largest distance of a training camera from the mean of them; 1 if all are at one place."""
        return self._center_and_extent()[1]

    def fingerprint(self) -> str:
        """A short hash of all that a run depends on: cameras, split, points, names, and the photos and masks."""
        digest = hashlib.sha256()
        split = torch.tensor([*self.train, -1, *self.test])
        for tensor in (self.viewmats, self.Ks, split, self.exact_points, self.point_colors):
            if tensor is not None:
                digest.update(str(tuple(tensor.shape)).encode())
                digest.update(tensor.contiguous().numpy().tobytes())
        digest.update(repr((self.names, self.images.sizes)).encode())
        digest.update(self.images.fingerprint())
        return digest.hexdigest()[:16]

    def normalized(self) -> "Capture":
        """The same capture where the training cameras are centred at the origin and the extent is 1.

        `normalization.invert` of the result leads back to the capture's own units.
        """
        center, extent = self._center_and_extent()
        viewmats = self.viewmats.clone()
        viewmats[:, :3, 3] = (viewmats[:, :3, 3] + viewmats[:, :3, :3] @ center) / extent
        points = None if self.exact_points is None else (self.exact_points - center) / extent
        before = self.normalization
        total = Normalization(before.invert(center), before.radius * extent)
        return replace(self, viewmats=viewmats, exact_points=points, normalization=total)

    def _center_and_extent(self) -> tuple[Float[Tensor, "3"], float]:
        centers = self.centers[self.train or list(range(len(self)))]
        center = centers.mean(dim=0)
        spread = float((centers - center).norm(dim=1).max())
        resolvable = 1e-9 * float(center.abs().max())
        return center, SPREAD_FACTOR * spread if spread > resolvable else 1.0


def load_capture(
    path: Path | str,
    *,
    images: str | None = None,
    width: int | None = None,
    masks: Path | str | None = None,
    memory: int | None = None,
    preload: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> Capture:
    """Read a COLMAP, nerfstudio or Blender scene in its own units, and decode its images in parallel.

    Args:
        path: the scene's folder.
        images: folder in the scene to take the images from (`images_4`); None for what the scene names.
        width: shrink images to this many pixels across (never enlarges); None shrinks those wider than 1600 to 1600.
        masks: folder with a mask for every image, white where pixels count; None for the scene's own, if any.
        memory: bytes that decoded images may take, beyond which they are streamed; None for half of what is free.
        preload: decode the images now, so that damaged ones are found; else each when it is first asked for.
        progress: called with (images decoded, images in all) while loading.

    Raises:
        InputError: as `etsplat.data.load.read_scene`; fewer than two images; damaged images or masks; images of
            another shape than their camera.
    """
    frames = read_scene(path, masks, images=images)
    check_count(frames.source, frames.frames)
    if width is not None and width < 1:
        raise ValueError(f"width: expected at least 1, got {width}")
    Ks, sizes = _intrinsics_and_sizes(frames, width)
    limit = available_memory() // 2 if memory is None else memory
    pictures = CaptureImages(frames.frames, sizes, limit)
    if preload:
        pictures.preload(progress)
    return Capture(
        viewmats=torch.stack([frame.viewmat for frame in frames.frames]),
        Ks=Ks,
        images=pictures,
        names=frames.view_names,
        train=frames.train,
        test=frames.test,
        exact_points=frames.points,
        point_colors=frames.point_colors,
        normalization=Normalization(torch.zeros(3, dtype=torch.float64), 1.0),
    )


def _intrinsics_and_sizes(frames: FrameSet, width: int | None) -> tuple[Float[Tensor, "B 3 3"], list[tuple[int, int]]]:
    """Ks in pixels of the loaded images, and the (width, height) of these."""
    Ks, sizes = [], []
    for frame in frames.frames:
        size = image_size(frame.image)
        across = min(size[0], MAX_WIDTH if width is None else width)
        target = (across, max(1, round(size[1] * across / size[0])))
        Ks.append(scaled_intrinsics(frames.source, frame, size, target))
        sizes.append(target)
    return torch.stack(Ks), sizes
