"""Where the object is, from masks alone: a sphere that encloses the visual hull.

The visual hull (Laurentini 1994) is the set of points that fall inside the silhouette in every view; it contains the
object.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from etsplat.core.cameras import camera_centers
from etsplat.core.errors import InputError
from etsplat.data.camera_coverage import axes_meeting_point
from etsplat.data.carving import Carving
from etsplat.data.dataset import Dataset
from etsplat.data.dataset_checks import check_training_views
from etsplat.data.silhouettes import Silhouette, reach_of, silhouette, touches_border

_CELLS = 48
"""Grid cells per side, at each of the levels."""

_LEVELS = 3
"""Each level divides the box of what the one before has left."""

_MASK_WIDTH = 200
"""Silhouettes are shrunk to about this many pixels across (a pixel counts as inside if any part of it was)."""


class _View(NamedTuple):
    """A shrunk silhouette with its camera.

    Attributes:
        viewmat: (4, 4) world to camera.
        K: (3, 3), for the shrunk picture.
        outside: (h, w) each pixel's distance to the silhouette, 0 inside.
        whole: whether it keeps off the border.
        silhouette: it, in its own size.
    """

    viewmat: np.ndarray
    K: np.ndarray
    outside: np.ndarray
    whole: bool
    silhouette: Silhouette


def bounding_sphere(dataset: Dataset) -> tuple[Float[Tensor, "3"], float]:
    """A sphere that encloses the object: centred where the optical axes meet best, out to the visual hull.

    The hull is carved from a grid between the cameras with the masks of the training views. A view whose silhouette
    keeps off the image border shows the whole object, so it also excludes what its image does not show; where the
    silhouette is cut by the border, nothing is known outside the image. A point of the hull is judged by at least
    half of the views, or by fewer where that predicts masks better; rough masks are believed as far as they predict
    each other (`Carving`).

    Args:
        dataset: photos with alpha, in any frame.

    Returns:
        center (3,) and radius, in the frame of the cameras.

    Raises:
        InputError: no masks; a view that sees nothing of the object or nothing else; axes that do not meet in front
            of the cameras; silhouettes that have no common point; a camera inside the hull.

    Example:
        >>> center, radius = etsplat.bounding_sphere(etsplat.photograph(etsplat.demo_object(), 32, 32))
        >>> 0.9 < radius < 1.1
        True
    """
    check_training_views(dataset.train)
    if len(dataset.train) == 1:
        raise InputError("views: 1 to train on; an object needs photos from around it, better 20")
    check_not_empty(dataset, dataset.train)
    names = [dataset.names[index] for index in dataset.train]
    steps = np.array([max(1, dataset.images.sizes[index][0] // _MASK_WIDTH) for index in dataset.train])
    inside = _silhouettes(dataset, names, steps)
    rounded = dataset.viewmats[dataset.train].float()  # as the cameras have them
    viewmats, center = rounded.double().numpy(), axes_meeting_point(rounded)
    if center is None:
        raise InputError("cameras: their axes are parallel and meet nowhere; photograph the object from around it")
    meeting = center.numpy()
    depth = viewmats[:, 2, :3] @ meeting + viewmats[:, 2, 3]
    if (depth <= 0).all():
        raise InputError(
            "cameras: all cameras look away from the object; the poses have other axes than was supposed: cameras look"
            " along +z with y down, but in transforms.json along -z with y up (docs/conventions.md)"
        )
    if (depth <= 0).any():
        raise InputError(
            f"view {names[depth.argmin()]}: looks away from where the others look; an object needs views around it"
        )
    silhouettes = [Silhouette(dataset, index) for index in dataset.train]
    carving = Carving.of(silhouettes, center.float(), reach_of(silhouettes, center.float()))
    outside = [
        (np.asarray(distance_transform_edt(~mask)) - carving.grown / step).clip(min=0)
        for mask, step in zip(inside, steps, strict=True)
    ]
    Ks = dataset.Ks[dataset.train].float().double().numpy()
    Ks[:, :2] /= steps[:, None, None]
    whole = [not touches_border(mask) for mask in inside]
    views = [_View(*each) for each in zip(viewmats, Ks, outside, whole, silhouettes, strict=True)]
    eyes = camera_centers(rounded).double().numpy()
    kept, cell = _carve(views, meeting, np.linalg.norm(eyes - meeting, axis=1).max(), carving)
    within = _keeps(views, eyes, 0.0, carving)
    if within.any():
        raise InputError(f"view {names[within.argmax()]}: its camera is inside the object; remove that view")
    radius = float(np.linalg.norm(kept - meeting, axis=1).max()) + cell * 3**0.5 / 2
    return center.float(), radius


def check_not_empty(dataset: Dataset, views: Sequence[int]) -> None:
    """Raises InputError where one of the views has a mask without a pixel of the object."""
    for index in views:
        if not silhouette(dataset.images[index]).any():
            raise InputError(
                f"view {dataset.names[index]}: its mask is empty, it sees nothing of the object; remove the view, or "
                "write 255 inside masks that have 1 there"
            )


def _carve(views: list[_View], center: np.ndarray, reach: float, carving: Carving) -> tuple[np.ndarray, float]:
    """Centres (N, 3) and side of the cubes that are left of the box `center` +- `reach`."""
    lower, upper = center - reach, center + reach
    kept, cell = center[None], reach
    for _ in range(_LEVELS):
        cell = float((upper - lower).max()) / _CELLS
        axes = [np.arange(lower[k] + cell / 2, upper[k], cell) for k in range(3)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        kept = points[_keeps(views, points, cell, carving)]
        if len(kept) == 0:
            raise InputError(
                "masks: the silhouettes have no point in common; check that masks are white inside the object and that"
                " poses and images belong together"
            )
        lower, upper = kept.min(axis=0) - cell / 2, kept.max(axis=0) + cell / 2
    return kept, cell


def _silhouettes(dataset: Dataset, names: list[str], steps: np.ndarray) -> list[np.ndarray]:
    """Masks of the training views, each so many times smaller; a pixel is inside if any of those in it was."""
    masks = [silhouette(dataset.images[index]) for index in dataset.train]
    full = [name for name, mask in zip(names, masks, strict=True) if mask.all()]
    if len(full) == len(names):
        raise InputError(
            "masks: the images have neither transparency nor masks, or these are white all over, so the object cannot"
            " be told from its background; add a folder masks/ with a white-on-black picture for every image, as"
            " `etsplat data masks` writes them of an object before a plain background or on a surface; photos in memory"
            " need an alpha channel"
        )
    if full:
        raise InputError(
            f"view {full[0]}: its mask covers the whole image; the mask is missing, or the camera is inside or too near"
            " the object: add the mask or remove the view"
        )
    return [_any_of(mask, step) for mask, step in zip(masks, steps, strict=True)]


def _any_of(mask: np.ndarray, step: int) -> np.ndarray:
    rows, columns = (np.arange(0, size, step) for size in mask.shape)
    return np.logical_or.reduceat(np.logical_or.reduceat(mask, rows), columns, axis=1)


def _keeps(views: list[_View], points: np.ndarray, cell: float, carving: Carving) -> np.ndarray:
    """(N,) whether the cube of side `cell` about each point may reach into the silhouettes of all that judge it.

    All but so many that are outvoted. In numpy: for thousands of small steps torch's threads are in the way.
    """
    alive = np.arange(len(points))
    judged, missed = np.zeros(len(points), dtype=np.int32), np.zeros(len(points), dtype=np.int32)
    for viewmat, K, outside, whole, _ in views:
        camera = points[alive] @ viewmat[:3, :3].T + viewmat[:3, 3]
        z = camera[:, 2]
        front = z > 0
        pixel = (camera[:, :2] / np.where(front, z, 1)[:, None]) * K.diagonal()[:2] + K[:2, 2]
        framed = front & ((pixel >= 0) & (pixel < outside.shape[::-1])).all(axis=1)
        column, row = pixel[framed].astype(np.int64).T
        # Half the cube's diagonal on the screen, and half a pixel's.
        reach = K[0, 0] * 0.87 * cell / z[framed] + 0.71
        keep = np.full(len(alive), not whole)
        keep[framed] = outside[row, column] <= reach
        judged[alive] += framed | whole
        missed[alive] += ~keep
        alive = alive[missed[alive] <= carving.outvoted]
    kept = np.zeros(len(points), dtype=bool)
    at, by = torch.from_numpy(points[alive]).float(), torch.from_numpy(judged[alive]).float()
    kept[alive] = carving.known([view.silhouette for view in views], at, by).numpy()
    return kept
