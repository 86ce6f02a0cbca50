"""Points that photos agree on: planes are swept through what a photo shows, and depths checked between photos.

Each photo is compared with its neighbours as they would look if all that it shows lay on one plane, for many planes
(Collins 1996). A pixel's depth is where small windows correlate best. It stays if that is clearly better than
elsewhere, and if other photos found the same place.
"""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from etsplat.data.agreement import reduced
from etsplat.data.dataset import Dataset
from etsplat.data.depth_points import framed, project, unproject
from etsplat.data.pictures import as_float, unpremultiplied
from etsplat.engines.threads import num_threads, one_torch_thread

WIDEST = 200
"""Photos are halved until none is wider: depths of larger ones are finer than triangles at the start need to be."""

PHOTOS = 64
"""So many photos at most are compared; of more, every second, third, ... one."""

SIDE_BY_SIDE = 4
"""So many photos at most are swept at a time, each by one thread; a third of a gigabyte each."""

NEIGHBOURS, AGREEING = 4, 2
"""Neighbours of a photo, and how many of them, the best ones, a depth is judged by: others may not see the place."""

ANGLE, NARROWER, WIDER = 8.0, 5.0, 10.0
"""Degrees between the rays of two photos to what both show, in the median, that suit best; and how fast a pair suits
less where they are less, or more."""

FEWEST_SHARED, ASKED = 20, 4000
"""Photos are no neighbours with fewer points in both; so many points are asked."""

PLANES, NEARER, FARTHER = (32, 160), 0.8, 1.3
"""Fewest and most planes: the widest neighbour moves by a pixel between two. They lie between what the nearest and the
farthest hundredth of the points are, times these factors."""

WINDOW = 5
"""Side of the windows that are correlated, in pixels."""

CORRELATED, CLEARLY, CONTRAST = 0.6, 0.03, 0.01
"""What the correlation must be, by how much more than at planes that are not beside the best one, and the standard
deviation of grey values in a window."""

BESIDE = 3
"""Planes that far from the best one are beside it."""

SAME, SEEN_BY = 0.015, 2
"""Depths in other photos are the same up to this part of them; in so many others a place must have been found."""


@dataclass(frozen=True)
class Swept:
    """What photos agree on.

    Attributes:
        positions: (P, 3) float64, in the frame of the data set.
        colors: (P, 3) float32 in [0, 1] as displayed.
        share: of the pixels that were compared, how many have a point.
    """

    positions: Float[Tensor, "P 3"]
    colors: Float[Tensor, "P 3"]
    share: float


@dataclass(frozen=True)
class _Photo:
    """A small photo, as view `index` of a data set of such.

    Attributes:
        colors: (h, w, 3).
        grey: (h, w).
        counts: (h, w), where it shows something that is not masked.
        center: (3,) float64 of the camera.
        rays: (h, w, 3) float64 from there through the middles of the pixels, to depth 1.
    """

    dataset: Dataset
    index: int
    colors: Float[Tensor, "h w 3"]
    grey: Float[Tensor, "h w"]
    counts: Bool[Tensor, "h w"]
    center: Float[Tensor, "3"]
    rays: Float[Tensor, "h w 3"]

    @staticmethod
    def of(dataset: Dataset, index: int) -> "_Photo":
        picture, (width, height) = dataset.images.picture(index), dataset.images.sizes[index]
        colors, counts = unpremultiplied(as_float(picture.pixels))
        if picture.mask is not None:
            counts = counts & (picture.mask > 127)
        row, column = (torch.cartesian_prod(torch.arange(height), torch.arange(width)) + 0.5).unbind(dim=1)
        center, one = dataset.centers[index], torch.ones(height * width, dtype=torch.float64)
        rays = unproject(dataset, index, one, column, row) - center
        return _Photo(dataset, index, colors, colors.mean(dim=2), counts, center, rays.view(height, width, 3))

    def to(self, device: torch.device) -> "_Photo":
        """For `_depths`, which compares there; cameras stay where they are."""
        moved = {name: getattr(self, name).to(device) for name in ("grey", "counts", "rays")}
        return replace(self, **moved)

    def located(self, points: Float[Tensor, "P 3"]) -> tuple[Tensor, Tensor, Tensor]:
        """(P,) depths of points, columns and rows of their pixels."""
        return project(self.dataset, self.index, points)

    def frames(self, located: tuple[Tensor, Tensor, Tensor]) -> Bool[Tensor, " P"]:
        """Whether they are in the photo."""
        return framed(self.dataset, self.index, *located)

    def places(self, depths: Float[Tensor, "h w"]) -> Float[Tensor, "P 3"]:
        """Of the pixels with a depth, in rows."""
        known = depths > 0
        return self.center + self.rays[known] * depths[known, None]


def swept_points(capture: Dataset, device: torch.device, progress: Callable[[int, int], None] | None = None) -> Swept:
    """The points that the training photos agree on.

    Args:
        capture: photos, with points that say how far away things are.
        device: where photos are compared; results are on the CPU.
        progress: called with (photos compared, photos in all).
    """
    assert capture.exact_points is not None
    some = capture.train[:: math.ceil(len(capture.train) / PHOTOS)]
    small = reduced(capture.of_views(some), WIDEST)
    photos, points = [_Photo.of(small, index) for index in small.train], capture.exact_points
    located = [photo.located(points) for photo in photos]
    inside = [photo.frames(each) for photo, each in zip(photos, located, strict=True)]
    asked = slice(None, None, math.ceil(len(points) / ASKED))
    beside = _neighbours(photos, points[asked], [each[asked] for each in inside])
    there = [photo.to(device) for photo in photos]

    def swept(number: int) -> Float[Tensor, "h w"]:
        near = [there[other] for other in beside[number]]
        return _depths(there[number], near, located[number][0][inside[number]]).cpu()

    depths = []
    with one_torch_thread(), ThreadPoolExecutor(min(num_threads(), SIDE_BY_SIDE)) as pool:
        for found in pool.map(swept, range(len(photos))):
            depths.append(found)
            if progress is not None:
                progress(len(depths), len(photos))
    positions, colors = [], []
    for number, (photo, found) in enumerate(zip(photos, depths, strict=True)):
        places = photo.places(found)
        others = [pair for other, pair in enumerate(zip(photos, depths, strict=True)) if other != number]
        agreed = _found_by(places, others) >= SEEN_BY
        positions.append(places[agreed])
        colors.append(photo.colors[found > 0][agreed])
    compared = sum(int(photo.counts.sum()) for photo in photos)
    count = sum(len(each) for each in positions)
    return Swept(torch.cat(positions), torch.cat(colors), count / max(compared, 1))


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
    device = photo.grey.device
    inverse = torch.linspace(1 / near, 1 / far, _planes(photo, others, near, far), device=device)
    correlations = torch.stack([_correlation(photo, other, inverse) for other in others])
    judged = correlations.topk(AGREEING, dim=0).values.mean(dim=0)
    best, plane = judged.max(dim=0)
    number = torch.arange(len(inverse), device=device)[:, None, None]
    elsewhere = judged.masked_fill((number - plane).abs() <= BESIDE, -1.0).amax(dim=0)
    within = plane.clamp(1, len(inverse) - 2)
    before, at, after = (judged.gather(0, (within + step)[None])[0] for step in (-1, 0, 1))
    between = ((before - after) / (2 * (before - 2 * at + after)).clamp_max(-1e-6)).clamp(-0.5, 0.5)
    found = 1 / (inverse[within] + between * (inverse[1] - inverse[0]))
    contrast = _spread(photo.grey[None, None])[1][0, 0].sqrt()
    clear = (best > CORRELATED) & (best - elsewhere > CLEARLY) & (contrast > CONTRAST) & (plane == within)
    return torch.where(clear & photo.counts, found, 0.0)


def _planes(photo: _Photo, others: Sequence[_Photo], near: float, far: float) -> int:
    """So many that the middle of the photo moves by a pixel in the widest of the others between two."""
    h, w = photo.grey.shape
    ends = photo.center + photo.rays[h // 2, w // 2].cpu() * torch.tensor([[near], [far]])
    widest = 0.0
    for other in others:
        depth, column, row = other.located(ends)
        move = math.hypot(float(column[0] - column[1]), float(row[0] - row[1]))
        widest = max(widest, move if bool((depth > 0).all()) else PLANES[1])
    return math.ceil(min(max(PLANES[0], widest), PLANES[1]))


def _correlation(photo: _Photo, other: _Photo, inverse: Float[Tensor, " D"]) -> Float[Tensor, "D h w"]:
    """Of the windows of a photo with those of another as each of the planes has it; -1 where that shows nothing."""
    h, w = other.grey.shape
    whole = torch.tensor([[2 / w, 0.0, -1.0], [0.0, 2 / h, -1.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    matrix = whole @ other.dataset.Ks[other.index] @ other.dataset.viewmats[other.index, :3]
    start = (matrix[:, :3] @ photo.center + matrix[:, 3]).float().to(inverse.device)
    along = photo.rays @ matrix[:, :3].T.to(inverse.device)
    seen = along.float() + start * inverse[:, None, None, None]
    places = seen[..., :2] / seen[..., 2:].clamp_min(1e-6)  # from -1 to 1 across the other
    outside = ~((places.abs() < 1).all(dim=-1) & (seen[..., 2] > 0))
    warped = grid_sample(other.grey.expand(len(inverse), 1, -1, -1), places, align_corners=False)
    grey = photo.grey[None, None]
    mean, variance = _spread(grey)
    there, varies = _spread(warped)
    together = _windows(warped * grey) - mean * there
    return (together / (variance * varies).sqrt())[:, 0].masked_fill(outside, -1.0)


def _spread(images: Float[Tensor, "D 1 h w"]) -> tuple[Float[Tensor, "D 1 h w"], Float[Tensor, "D 1 h w"]]:
    """Mean and variance in the window around each pixel."""
    mean = _windows(images)
    return mean, (_windows(images.square()) - mean.square()).clamp_min(1e-6)


def _windows(images: Float[Tensor, "D 1 h w"]) -> Float[Tensor, "D 1 h w"]:
    """Means of the windows around each pixel, of what of them is in the image."""
    half = WINDOW // 2  # sums of shifted images take a seventh of the time of torch's pooling
    for axis in (-1, -2):
        size, sums = images.shape[axis], images.clone()
        for step in range(1, min(half, size - 1) + 1):
            left, right = (0, size - step), (step, size - step)
            sums.narrow(axis, *left).add_(images.narrow(axis, *right))
            sums.narrow(axis, *right).add_(images.narrow(axis, *left))
        place = torch.arange(size, device=images.device)
        counts = 1 + place.clamp_max(half) + (size - 1 - place).clamp_max(half)
        images = sums / counts.view(-1, *[1] * (-1 - axis))
    return images


def _found_by(
    places: Float[Tensor, "P 3"], others: Sequence[tuple[_Photo, Float[Tensor, "h w"]]]
) -> Float[Tensor, " P"]:
    """In how many other photos each place was found."""
    count = torch.zeros(len(places))
    for photo, depths in others:
        expected, column, row = located = photo.located(places)
        inside = photo.frames(located)
        column, row = (torch.where(inside, each, 0.0).long() for each in (column, row))
        there = depths[row, column]
        count += inside & (there > 0) & ((there - expected).abs() < SAME * expected)
    return count
