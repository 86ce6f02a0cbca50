"""Photos of an object as what is asked of its surface looks at them: as small as will do, each with its camera."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn.functional import grid_sample, max_pool2d

from etsplat import _native
from etsplat.core.cameras import camera_centers
from etsplat.data.close_ups import object_side
from etsplat.data.dataset import Dataset
from etsplat.data.kept import kept
from etsplat.data.pictures import as_float

_LONGEST = 240
"""Photos are halved until the object is no longer in them: agreement asks for texture, not for detail."""

_NEAR_PLANE = 0.01
"""Of cameras around an object in the unit ball, which none is in."""


@dataclass(frozen=True)
class Photo:
    """A photo with its camera: (1, 4, H, W) pixels, (4, 4), (3, 3) and (3,)."""

    pixels: Tensor
    viewmat: Tensor
    K: Tensor
    center: Tensor

    @staticmethod
    def of(dataset: Dataset, index: int, pixels: Tensor) -> "Photo":
        """Pixels as a view of a data set sees them."""
        viewmat, K = dataset.viewmats[index].float(), dataset.Ks[index].float()
        return Photo(pixels, viewmat, K, camera_centers(viewmat[None])[0])

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """(..., 2) places as `grid_sample` has them, and (...) depths, of (..., 3) points."""
        # Each coordinate in a row of memory: products of (N, 3) with a matrix take ten times as long.
        rows = points.reshape(-1, 3).T.contiguous()
        camera = self.viewmat[:3, :3] @ rows + self.viewmat[:3, 3:]
        z = camera[2]
        height, width = self.pixels.shape[2:]
        pixel = self.K[:2] @ camera / torch.where(z > 0, z, 1.0)
        place = 2 * pixel / torch.tensor([[width], [height]]) - 1
        return torch.where(z > 0, place, 2.0).T.reshape(*points.shape[:-1], 2), z.view(points.shape[:-1])

    def in_pixels(self, places: Tensor) -> Tensor:
        """(..., 2) columns and rows of (..., 2) places from `project`; 0.5 at the middle of the first pixel."""
        return (places + 1) / 2 * torch.tensor(self.pixels.shape[:1:-1])

    def drawing(self, vertices: Tensor, faces: Tensor) -> dict[str, Any]:
        """Arguments of native calls that draw a surface as it sees it."""
        camera = {"viewmat": self.viewmat, "K": self.K, "near_plane": _NEAR_PLANE}
        return {"vertices": vertices.detach().contiguous(), "faces": faces.to(torch.int32).contiguous(), **camera}

    def look_up(self, planes: Tensor, places: Tensor, mode: str = "bilinear") -> Tensor:
        """(C, N, M) values of (1, C, H, W) planes at (N, M, 2) places; 0 outside."""
        return grid_sample(planes, places[None], mode=mode, align_corners=False)[0]


@kept
def reduced(dataset: Dataset, longest: int = _LONGEST) -> Dataset:
    """Halved until the object is no longer in its training views, by default than agreement of surfaces asks for.

    However much of a photo is background, what is shown of the object counts.
    """
    side = object_side(dataset)
    while side > longest:
        dataset, side = dataset.halved(), side / 2
    return dataset


def photos_of(dataset: Dataset) -> list[Photo]:
    """Of the training views, as `reduced` makes them."""
    return _photos(reduced(dataset))


@kept
def _photos(dataset: Dataset) -> list[Photo]:
    pixels = (as_float(dataset.images[index]).permute(2, 0, 1)[None].contiguous() for index in dataset.train)
    return [Photo.of(dataset, *each) for each in zip(dataset.train, pixels, strict=True)]


def blank_photos(dataset: Dataset) -> list[Photo]:
    """The training views as cameras alone, which show nothing."""
    sizes = (dataset.images.sizes[index] for index in dataset.train)
    blank = (torch.zeros(1).expand(1, 4, height, width) for width, height in sizes)
    return [Photo.of(dataset, *each) for each in zip(dataset.train, blank, strict=True)]


def pixel_size(photos: list[Photo]) -> float:
    """How large a pixel is at the object, in its units."""
    distance = torch.stack([photo.center.norm() for photo in photos]).mean()
    return float(distance / photos[0].K[0, 0])


Hit: TypeAlias = tuple[Float[Tensor, "H W"], Int64[Tensor, "H W"]]
"""The depth of a surface at each pixel of a photo, 0 where there is none, and its face, else -1."""


def first_hits(photo: Photo, vertices: Tensor, faces: Tensor) -> Hit:
    """Where a photo sees a surface first."""
    size = photo.pixels.shape[2:]
    triangle, depth = torch.empty(size, dtype=torch.int32), torch.empty(size)
    _native.rasterize_opaque(**photo.drawing(vertices, faces), triangle=triangle, barycentrics=None, depth=depth)
    return depth, triangle.long()


def seen_by(photos: list[Photo], hits: list[Hit], points: Tensor, pixel: float) -> Bool[Tensor, "B V"]:
    """Which photos see which points of the surface (V, 3), whose pixels are so large."""
    seen = []
    for photo, (depth, _) in zip(photos, hits, strict=True):
        place, z = photo.project(points)
        around = max_pool2d(depth[None, None], 3, stride=1, padding=1)
        seen.append(z <= photo.look_up(around, place[None], "nearest")[0, 0] + 1.5 * pixel)
    return torch.stack(seen)


class PixelsOf:
    """At which pixels photos show points, of all photos at once; pixels are numbered one photo behind another.

    A product and a look-up for each photo are slow.
    """

    def __init__(self, photos: Sequence[Photo]) -> None:
        self._rotations = torch.cat([photo.viewmat[:3, :3] for photo in photos])
        self._offsets = torch.cat([photo.viewmat[:3, 3:] for photo in photos])
        self._Ks = torch.stack([photo.K for photo in photos])[..., None]
        heights, widths = torch.tensor([photo.pixels.shape[2:] for photo in photos]).T[..., None]
        self._heights, self._widths = heights, widths
        sizes = heights * widths
        self._first, self._none = sizes.cumsum(0) - sizes, int(sizes.sum())

    def show(self, points: Float[Tensor, "N 3"]) -> tuple[Int64[Tensor, "B N"], Float[Tensor, "B N"]]:
        """The number of the pixel at which each photo shows each point, and its depth; of none beside the photo."""
        # Each coordinate in a row of memory: products of (N, 3) with a matrix take ten times as long.
        x, y, z = (self._rotations @ points.T.contiguous() + self._offsets).view(-1, 3, len(points)).unbind(1)
        per_depth = 1 / torch.where(z > 0, z, torch.nan)
        column, row = ((K[:, 0] * x + K[:, 1] * y + K[:, 2] * z) * per_depth for K in self._Ks[:, :2].unbind(1))
        shown = (column >= 0) & (column < self._widths) & (row >= 0) & (row < self._heights)
        number = self._first + row.nan_to_num().long() * self._widths + column.nan_to_num().long()
        return torch.where(shown, number, self._none), z

    def together(self, maps: Sequence[Tensor]) -> Tensor:
        """What (H, W) maps of the photos have at each pixel, by its number; 0 where there is none."""
        return torch.cat([*(each.flatten() for each in maps), maps[0].new_zeros(1)])
