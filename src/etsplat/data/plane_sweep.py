"""Points that photos agree on: planes are swept through what a photo shows, and depths checked between photos.

Each photo is compared with its neighbours as they would look if all that it shows lay on one plane, for many planes
(Collins 1996). A pixel's depth is where small windows correlate best. It stays if that is clearly better than
elsewhere, and if other photos found the same place.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn.functional import normalize

from etsplat.data.dataset import Dataset
from etsplat.data.depth_points import framed, on_map, project
from etsplat.data.pictures import as_float, unpremultiplied
from etsplat.data.plane_matches import AGREEING, Neighbour, best_matches
from etsplat.engines.threads import num_threads, one_torch_thread

WIDEST = 200
"""Photos are halved until none is wider: depths of larger ones are finer than triangles at the start need to be."""

PHOTOS = 64
"""So many photos at most are compared; of more, every second, third, ... one."""

GUESSED = 0.2, 20.0
"""Where a capture has no points, things are supposed to be between so far away, relative to its extent."""

NEIGHBOURS = 4
"""Photos that a photo is compared with."""

ANGLE, NARROWER, WIDER = 8.0, 5.0, 10.0
"""Degrees between the rays of two photos to what both show, in the median, that suit best; and how fast a pair suits
less where they are less, or more."""

FEWEST_SHARED, ASKED = 20, 4000
"""Photos are no neighbours with fewer points in both; so many points are asked."""

PLANES, NEARER, FARTHER = (32, 160), 0.8, 1.3
"""Fewest and most planes: the widest neighbour moves by a pixel between two. They lie between what the nearest and the
farthest hundredth of the points are, times these factors."""

CORRELATED, CLEARLY, CONTRAST = 0.6, 0.03, 0.01
"""What the correlation must be, by how much more than at planes that are not beside the best one, and the standard
deviation of grey values in a window."""

SAME, SEEN_BY = 0.015, 2
"""Depths in other photos are the same up to this part of them; in so many others a place must have been found."""

TOLD_BY = 0.02
"""Of the pixels, how many must have a depth so that these say something of the poses."""


@dataclass(frozen=True)
class Swept:
    """What photos agree on.

    Attributes:
        positions: (P, 3) float64, in the frame of the data set.
        colors: (P, 3) float32 in [0, 1] as displayed.
        share: of the pixels that were compared, how many have a point.
        consistent: of the places that each photo found, how many the photos that it was compared with found too, which
            poses that are off by a pixel leave few of; NaN where hardly any was found.
    """

    positions: Float[Tensor, "P 3"]
    colors: Float[Tensor, "P 3"]
    share: float
    consistent: float


@dataclass(frozen=True)
class _Photo:
    """A small photo, as view `index` of a data set of such.

    Attributes:
        colors: (h, w, 3).
        grey: (h, w).
        counts: (h, w), where it shows something that is not masked.
        center: (3,) float64 of the camera.
        rays: (3, 3) float64 from a place (x, y, 1) in pixels to the ray from there through it, to depth 1.
    """

    dataset: Dataset
    index: int
    colors: Float[Tensor, "h w 3"]
    grey: Float[Tensor, "h w"]
    counts: Bool[Tensor, "h w"]
    center: Float[Tensor, "3"]
    rays: Float[Tensor, "3 3"]

    @staticmethod
    def of(dataset: Dataset, index: int) -> "_Photo":
        picture = dataset.images.picture(index)
        colors, counts = unpremultiplied(as_float(picture.pixels))
        if picture.mask is not None:
            counts = counts & (picture.mask > 127)
        rays = dataset.viewmats[index, :3, :3].T @ torch.linalg.inv(dataset.Ks[index])
        return _Photo(dataset, index, colors, colors.mean(dim=2), counts, dataset.centers[index], rays)

    def to(self, device: torch.device) -> "_Photo":
        """For `_depths`, which compares there; cameras stay where they are."""
        return replace(self, grey=self.grey.to(device), counts=self.counts.to(device))

    def beside(self, other: "_Photo") -> Neighbour:
        """Another photo, to compare this one with."""
        matrix = other.dataset.Ks[other.index] @ other.dataset.viewmats[other.index, :3]
        rays, start = matrix[:, :3] @ self.rays, matrix[:, :3] @ self.center + matrix[:, 3]
        return Neighbour(other.grey, rays.to(other.grey.device), start.to(other.grey.device))

    def located(self, points: Float[Tensor, "P 3"]) -> tuple[Tensor, Tensor, Tensor]:
        """(P,) depths of points, columns and rows of their pixels."""
        return project(self.dataset, self.index, points)

    def frames(self, located: tuple[Tensor, Tensor, Tensor]) -> Bool[Tensor, " P"]:
        """Whether they are in the photo."""
        return framed(self.dataset, self.index, *located)

    def places(self, depths: Float[Tensor, "h w"]) -> Float[Tensor, "P 3"]:
        """Of the pixels with a depth, in rows."""
        known = depths > 0
        row, column = known.nonzero().T.double() + 0.5
        rays = self.rays @ torch.stack([column, row, torch.ones_like(row)])
        return self.center + rays.T * depths[known, None]


def guessed_points(capture: Dataset) -> Float[Tensor, "P 3"]:
    """Places that training photos look at, were they at any depth: for sweeps of captures without points."""
    generator, each = torch.Generator().manual_seed(0), math.ceil(ASKED / len(capture.train))
    near, far = (math.log(factor * capture.extent) for factor in GUESSED)
    places = []
    for view in capture.train:
        across, depths = torch.rand((2, each), generator=generator), torch.rand(each, generator=generator)
        sizes = torch.tensor(capture.images.sizes[view])
        pixels = torch.cat([across * sizes[:, None], torch.ones((1, each))]).double()
        rays = capture.viewmats[view, :3, :3].T @ torch.linalg.inv(capture.Ks[view]) @ pixels
        places.append(capture.centers[view] + ((near + depths.double() * (far - near)).exp() * rays).T)
    return torch.cat(places)


def swept_points(
    capture: Dataset,
    device: torch.device,
    progress: Callable[[int, int], None] | None = None,
    *,
    widest: int = WIDEST,
) -> Swept:
    """The points that the training photos agree on.

    Args:
        capture: photos, with points that say how far away things are.
        device: where photos are compared; results are on the CPU.
        progress: called with (photos compared, photos in all).
        widest: photos are halved until none is wider.
    """
    assert capture.exact_points is not None
    some = capture.train[:: math.ceil(len(capture.train) / PHOTOS)]
    small = capture.of_views(some)
    while max(width for width, _ in small.images.sizes) > widest:
        small = small.halved()
    photos, points = [_Photo.of(small, index) for index in small.train], capture.exact_points
    located = [photo.located(points) for photo in photos]
    inside = [photo.frames(each) for photo, each in zip(photos, located, strict=True)]
    asked = slice(None, None, math.ceil(len(points) / ASKED))
    beside = _neighbours(photos, points[asked], [each[asked] for each in inside])
    there = [photo.to(device) for photo in photos]

    depths = list[Tensor]()
    with one_torch_thread(), ThreadPoolExecutor(num_threads()) as pool:
        for number, others in enumerate(beside):
            near, known = [there[other] for other in others], located[number][0][inside[number]]
            depths.append(_depths(there[number], near, known).cpu())
            if progress is not None:
                progress(len(depths), len(photos))
        agreed = list(pool.map(lambda number: _agreed(photos, depths, number, beside[number]), range(len(photos))))
    positions = [photo.places(found)[kept] for photo, found, (kept, _) in zip(photos, depths, agreed, strict=True)]
    colors = [photo.colors[found > 0][kept] for photo, found, (kept, _) in zip(photos, depths, agreed, strict=True)]
    compared = sum(int(photo.counts.sum()) for photo in photos)
    clear = sum(int((each > 0).sum()) for each in depths)
    count = sum(len(each) for each in positions)
    consistent = sum(near for _, near in agreed) / clear if clear > TOLD_BY * compared else math.nan
    return Swept(torch.cat(positions), torch.cat(colors), count / max(compared, 1), consistent)


def _neighbours(
    photos: Sequence[_Photo], points: Float[Tensor, "P 3"], framed: Sequence[Bool[Tensor, " P"]]
) -> list[list[int]]:
    """Of each photo, those that show most of the same from an angle that suits, the best first."""
    rays = [normalize(points - photo.center, dim=1) for photo in photos]
    chosen = []
    for number, inside in enumerate(framed):
        suits = []
        for other, there in enumerate(framed):
            both = inside & there
            if other == number or (shared := int(both.sum())) < FEWEST_SHARED:
                continue
            cosines = (rays[number][both] * rays[other][both]).sum(dim=1)
            off = math.degrees(math.acos(min(1.0, float(cosines.median())))) - ANGLE
            spread = NARROWER if off < 0 else WIDER
            suits.append((shared * math.exp(-0.5 * (off / spread) ** 2), other))
        chosen.append([other for _, other in sorted(suits, reverse=True)[:NEIGHBOURS]])
    return chosen


def _depths(photo: _Photo, others: Sequence[_Photo], known: Float[Tensor, " K"]) -> Float[Tensor, "h w"]:
    """Of each pixel, 0 where it is not clear."""
    if len(others) < AGREEING or len(known) < FEWEST_SHARED:
        return torch.zeros_like(photo.grey)
    ordered = known.sort().values
    near = NEARER * float(ordered[len(ordered) // 100])
    far = FARTHER * float(ordered[-1 - len(ordered) // 100])
    planes = _planes(photo, others, near, far)
    inverse = torch.linspace(1 / near, 1 / far, planes, device=photo.grey.device)
    found = best_matches(photo.grey, [photo.beside(other) for other in others], inverse)
    clear = (found.best > CORRELATED) & (found.best - found.elsewhere > CLEARLY) & (found.contrast > CONTRAST)
    depths = 1 / (inverse[0] + found.place * (inverse[1] - inverse[0]))
    return torch.where(clear & (found.place >= 0) & photo.counts, depths, 0.0)


def _planes(photo: _Photo, others: Sequence[_Photo], near: float, far: float) -> int:
    """So many that the middle of the photo moves by a pixel in the widest of the others between two."""
    h, w = photo.grey.shape
    middle = photo.rays @ torch.tensor([w // 2 + 0.5, h // 2 + 0.5, 1.0], dtype=torch.float64)
    ends = photo.center + middle * torch.tensor([[near], [far]])
    widest = 0.0
    for other in others:
        depth, column, row = other.located(ends)
        move = math.hypot(float(column[0] - column[1]), float(row[0] - row[1]))
        widest = max(widest, move if bool((depth > 0).all()) else PLANES[1])
    return math.ceil(min(max(PLANES[0], widest), PLANES[1]))


def _agreed(
    photos: Sequence[_Photo], depths: Sequence[Float[Tensor, "h w"]], number: int, first: Sequence[int]
) -> tuple[Bool[Tensor, " P"], int]:
    """Whether other photos found the places that one has a depth of, in `SEEN_BY` of them; and how many the first did.

    Args:
        photos: all.
        depths: of each.
        number: whose places they are.
        first: photos that are asked first, for what they agree to is not asked again.
    """
    places = photos[number].places(depths[number])
    count, doubtful = torch.zeros(len(places), dtype=torch.int32), torch.arange(len(places))

    def ask(some: Iterable[int], doubtful: Int64[Tensor, " D"]) -> Int64[Tensor, " E"]:
        for other in some:
            count[doubtful] += _found(photos[other], depths[other], places[doubtful])
            doubtful = doubtful[count[doubtful] < SEEN_BY]
        return doubtful

    doubtful = ask(first, doubtful)
    near = len(places) - len(doubtful)
    ask((each for each in range(len(photos)) if each not in (number, *first)), doubtful)
    return count >= SEEN_BY, near


def _found(photo: _Photo, depths: Float[Tensor, "h w"], places: Float[Tensor, "P 3"]) -> Bool[Tensor, " P"]:
    """Whether a photo found the same places."""
    there, expected = on_map(photo.dataset, photo.index, depths, places)
    return (there > 0) & ((there - expected).abs() < SAME * expected)
