"""Points that photos agree on: planes are swept through what a photo shows, and depths checked between photos.

Each photo is compared with its neighbours as they would look if all that it shows lay on one plane, for many planes
(Collins 1996). A pixel's depth is where small windows correlate best. It stays if that is clearly better than
elsewhere, and if other photos found the same place.
"""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate, normalize

from etsplat.data.dataset import Dataset
from etsplat.data.pictures import as_float
from etsplat.engines.threads import num_threads, one_torch_thread

SIDE = 200
"""Longer side of the photos that are compared, in pixels: depths of larger ones are finer than triangles at the start
need to be."""

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
    """A small photo and its camera: x_camera = rotation x + shift.

    Attributes:
        colors: (3, h, w).
        grey: (h, w).
        counts: (h, w), where it shows something that is not masked.
        rays: (h, w, 3) float64 through the middles of the pixels, 1 deep, in the camera's axes.
    """

    colors: Float[Tensor, "3 h w"]
    grey: Float[Tensor, "h w"]
    counts: Bool[Tensor, "h w"]
    K: Float[Tensor, "3 3"]
    rotation: Float[Tensor, "3 3"]
    shift: Float[Tensor, "3"]
    rays: Float[Tensor, "h w 3"]

    @property
    def center(self) -> Float[Tensor, "3"]:
        return -self.rotation.T @ self.shift

    def projected(self, points: Float[Tensor, "P 3"]) -> tuple[Float[Tensor, "P 2"], Float[Tensor, " P"]]:
        """Pixels, and depths; pixels mean nothing where depths are not positive."""
        seen = points @ self.rotation.T + self.shift
        depths = seen[:, 2]
        return (seen @ self.K.T)[:, :2] / depths[:, None], depths

    def framed(self, pixels: Float[Tensor, "P 2"], depths: Float[Tensor, " P"]) -> Bool[Tensor, " P"]:
        size = torch.tensor([self.grey.shape[1], self.grey.shape[0]])
        return (depths > 0) & ((pixels >= 0) & (pixels < size)).all(dim=1)

    def places(self, depths: Float[Tensor, "h w"]) -> Float[Tensor, "P 3"]:
        """Of the pixels with a depth, in rows."""
        known = depths > 0
        return (self.rays[known] * depths[known, None].double() - self.shift) @ self.rotation


def swept_points(capture: Dataset, progress: Callable[[int, int], None] | None = None) -> Swept:
    """The points that the training photos agree on.

    Args:
        capture: photos, with points that say how far away things are.
        progress: called with (photos compared, photos in all).
    """
    assert capture.exact_points is not None
    every = math.ceil(len(capture.train) / PHOTOS)
    photos = [_small(capture, view) for view in capture.train[::every]]
    points = capture.exact_points
    framed = [photo.framed(*photo.projected(points)) for photo in photos]
    some = slice(None, None, math.ceil(len(points) / ASKED))
    beside = _neighbours(photos, points[some], [inside[some] for inside in framed])

    def swept(number: int) -> Float[Tensor, "h w"]:
        photo, near = photos[number], [photos[other] for other in beside[number]]
        return _depths(photo, near, photo.projected(points[framed[number]])[1])

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
        colors.append(photo.colors.permute(1, 2, 0)[found > 0][agreed])
    compared = sum(int(photo.counts.sum()) for photo in photos)
    count = sum(len(each) for each in positions)
    return Swept(torch.cat(positions), torch.cat(colors), count / max(compared, 1))


def _small(capture: Dataset, view: int) -> _Photo:
    picture, (width, height) = capture.images.picture(view), capture.images.sizes[view]
    pixels = as_float(picture.pixels).permute(2, 0, 1)
    alpha = pixels[3:] if len(pixels) == 4 else torch.ones_like(pixels[:1])
    counts = alpha if picture.mask is None else alpha * (picture.mask > 127)
    scale = min(1.0, SIDE / max(width, height))
    h, w = max(1, round(height * scale)), max(1, round(width * scale))
    small = interpolate(torch.cat([pixels[:3], alpha, counts])[None], size=(h, w), mode="area")[0]
    colors = (small[:3] / small[3:4].clamp_min(1e-3)).clamp(0.0, 1.0)
    K = capture.Ks[view].double() * torch.tensor([[w / width], [h / height], [1.0]], dtype=torch.float64)
    rows, columns = torch.meshgrid(
        torch.arange(h, dtype=torch.float64) + 0.5, torch.arange(w, dtype=torch.float64) + 0.5, indexing="ij"
    )
    rays = torch.stack([columns, rows, torch.ones_like(rows)], dim=-1) @ torch.linalg.inv(K).T
    pose = capture.viewmats[view].double()
    return _Photo(colors, colors.mean(dim=0), small[4] > 0.5, K, pose[:3, :3], pose[:3, 3], rays)


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
    inverse = torch.linspace(1 / near, 1 / far, _planes(photo, others, near, far))
    correlations = torch.stack([_correlation(photo, other, inverse) for other in others])
    judged = correlations.topk(AGREEING, dim=0).values.mean(dim=0)
    best, plane = judged.max(dim=0)
    number = torch.arange(len(inverse))[:, None, None]
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
    ray = photo.rays[h // 2, w // 2]
    ends = torch.stack([(ray * depth - photo.shift) @ photo.rotation for depth in (near, far)])
    widest = 0.0
    for other in others:
        pixels, depths = other.projected(ends)
        move = float((pixels[0] - pixels[1]).norm())
        widest = max(widest, move if bool((depths > 0).all()) else PLANES[1])
    return math.ceil(min(max(PLANES[0], widest), PLANES[1]))


def _correlation(photo: _Photo, other: _Photo, inverse: Float[Tensor, " D"]) -> Float[Tensor, "D h w"]:
    """Of the windows of a photo with those of another as each of the planes has it; -1 where that shows nothing."""
    h, w = other.grey.shape
    whole = torch.tensor([[2 / w, 0.0, -1.0], [0.0, 2 / h, -1.0], [0.0, 0.0, 1.0]], dtype=torch.float64) @ other.K
    turn = other.rotation @ photo.rotation.T
    start = (whole @ (other.shift - turn @ photo.shift)).float()
    seen = (photo.rays @ (whole @ turn).T).float() + start * inverse[:, None, None, None]
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
        place = torch.arange(size)
        counts = 1 + place.clamp_max(half) + (size - 1 - place).clamp_max(half)
        images = sums / counts.view(-1, *[1] * (-1 - axis))
    return images


def _found_by(
    places: Float[Tensor, "P 3"], others: Sequence[tuple[_Photo, Float[Tensor, "h w"]]]
) -> Float[Tensor, " P"]:
    """In how many other photos each place was found."""
    count = torch.zeros(len(places))
    for photo, depths in others:
        pixels, expected = photo.projected(places)
        framed = photo.framed(pixels, expected)
        column, row = torch.where(framed[:, None], pixels, 0.0).long().unbind(dim=1)
        there = depths[row, column]
        count += framed & (there > 0) & ((there - expected).abs() < SAME * expected)
    return count
