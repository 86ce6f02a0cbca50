"""Masks of objects in front of a plain background, by its colours alone: nothing is learned, nothing is fetched.

A background is plain if its colours change smoothly over the picture, as those of a wall, a screen, or a sheet of paper
in even light do. What differs from it is the object: its shadow too, and what it stands on. What has the background's
colour is background, on the object too.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy import ndimage

WORK_SIZE = 1024
"""Pixels of the longer side that masks are found at."""

_BORDER = 0.03
"""Of the shorter side: so wide is the frame that has to show background."""

_LEAST_BORDER = 0.93
"""Of the frame: less background, and the object touches the border, or the background is not plain."""

_ROUGHEST = 0.022
"""Of the range of colours: a standard deviation beyond it is a pattern, no plain background."""

_FAR, _LEAST_FAR = 4.5, 0.045
"""What differs by so many standard deviations of the background, and so much of the range of colours, is none of it."""

_SEED = 2.0
"""Times that: an object has to differ so clearly somewhere in each of its parts."""

_SMALLEST, _LARGEST = 0.005, 0.85
"""Of the picture that an object may cover."""

_PART = 0.02
"""Of the largest part: smaller ones are specks."""

_HOLE = 2e-4
"""Of the picture: smaller gaps are parts of the object that look like the background by chance."""

_RIM = 3
"""Pixels next to the background that may show a part of it."""

_DEGREES = (1, 2, 3, 3)
"""Of what is fitted to the background, first to the frame, then each time to all that belongs to it."""


@dataclass(frozen=True)
class Found:
    """What is in front of a plain background.

    Attributes:
        mask: where the object is; None where the background is not plain.
        problem: why there is no mask; empty where there is one.
    """

    mask: Bool[np.ndarray, "H W"] | None
    problem: str = ""


def find_object(pixels: UInt8[np.ndarray, "H W 3"]) -> Found:
    """The object in a picture, about `WORK_SIZE` pixels long, whose background is plain."""
    colors = pixels.astype(np.float32) / 255
    height, width = colors.shape[:2]
    side = max(2, round(_BORDER * min(height, width)))
    frame = np.ones((height, width), dtype=bool)
    frame[side:-side, side:-side] = False
    smooth = np.stack([ndimage.gaussian_filter(colors[..., c], 1.0) for c in range(3)], axis=2)
    terms = _terms(height, width)
    chosen, far, spread = frame, np.zeros((height, width), dtype=np.float32), 0.0
    for degree in _DEGREES:
        residual = smooth - _fitted(smooth, chosen, terms, degree)
        spread = _spread(residual, chosen)
        far = np.sqrt((residual**2).sum(axis=2)) / max(_FAR * spread, _LEAST_FAR)
        chosen = _joined_to(far < 1, frame)
    if spread > _ROUGHEST:
        return Found(None, "the background has a pattern")
    if chosen[frame].mean() < _LEAST_BORDER:
        return Found(None, "the background is not plain along the border, or the object touches it")
    return _object_of(far, chosen)


def _object_of(far: Float[np.ndarray, "H W"], outside: Bool[np.ndarray, "H W"]) -> Found:
    """The object, by how far each pixel is from the background (1: just so far that it is none)."""
    area = far.size
    inside = ~outside
    gaps, count = _labelled(inside & (far < 1))
    sizes = np.bincount(gaps.ravel(), minlength=count + 1)
    inside &= ~((sizes >= max(4, _HOLE * area)) & (np.arange(count + 1) > 0))[gaps]
    inside = _at_half(inside, far)
    parts, count = _labelled(inside)
    if count == 0:
        return Found(None, "nothing stands out from the background")
    sizes = np.bincount(parts.ravel(), minlength=count + 1)[1:]
    clear = np.asarray(ndimage.maximum(far, parts, np.arange(1, count + 1))) >= _SEED
    kept = (sizes >= _PART * sizes.max()) & clear
    mask = np.concatenate([[False], kept])[parts]
    share = float(mask.mean())
    if share < _SMALLEST:
        return Found(None, "nothing large enough stands out from the background")
    if share > _LARGEST:
        return Found(None, "hardly any background is seen")
    return Found(mask)


def _at_half(inside: Bool[np.ndarray, "H W"], far: Float[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Without the pixels of the rim that show less than half of the object, by how different from the background it is.

    A little of it is enough to be different, so that what is different is wider than the object.
    """
    rim = inside & ~ndimage.binary_erosion(inside, iterations=_RIM, border_value=1)
    return inside & ~(rim & (far < 0.5 * ndimage.maximum_filter(far, 2 * _RIM + 1)))


def _terms(height: int, width: int) -> Float[np.ndarray, "H W 10"]:
    """Products of x and y in [-1, 1] up to degree 3, by degree."""
    y, x = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
    powers = [x**i * y ** (d - i) for d in range(4) for i in range(d, -1, -1)]
    return np.stack(powers, axis=2).astype(np.float32)


_COUNTS = (1, 3, 6, 10)
"""Of the terms up to each degree."""

_SAMPLES = 20_000


def _fitted(
    colors: Float[np.ndarray, "H W 3"], chosen: Bool[np.ndarray, "H W"], terms: Float[np.ndarray, "H W 10"], degree: int
) -> Float[np.ndarray, "H W 3"]:
    """Smooth colours like those of the chosen pixels, of which what differs from most is left out, three times over."""
    terms = terms[..., : _COUNTS[degree]]
    places = np.flatnonzero(chosen)
    places = places[:: max(1, len(places) // _SAMPLES)]
    A, B = terms.reshape(-1, terms.shape[2])[places], colors.reshape(-1, 3)[places]
    keep = np.ones(len(places), dtype=bool)
    solution = np.zeros((A.shape[1], 3), dtype=np.float32)
    for _ in range(3):
        solution = np.linalg.lstsq(A[keep], B[keep], rcond=None)[0].astype(np.float32)
        error = np.sqrt(((B - A @ solution) ** 2).sum(axis=1))
        keep = error <= max(2.5 * float(np.median(error)), 1 / 255)
    return terms @ solution


def _spread(residual: Float[np.ndarray, "H W 3"], chosen: Bool[np.ndarray, "H W"]) -> float:
    """A standard deviation of what is chosen, whatever a minority of it does: from the median of distances."""
    distance = np.sqrt((residual[chosen] ** 2).sum(axis=1))
    return float(np.median(distance)) / 1.538  # the median length of normal vectors with three components


def _labelled(mask: Bool[np.ndarray, "H W"]) -> tuple[Int[np.ndarray, "H W"], int]:
    """Connected parts numbered from 1, and how many."""
    labels = np.empty(mask.shape, dtype=np.int32)
    ndimage.label(mask, output=labels)
    return labels, int(labels.max())


def _joined_to(alike: Bool[np.ndarray, "H W"], frame: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """What is alike and joined to the frame."""
    labels, count = _labelled(alike)
    touching = np.zeros(count + 1, dtype=bool)
    touching[np.unique(labels[frame])] = True
    touching[0] = False
    return touching[labels]
