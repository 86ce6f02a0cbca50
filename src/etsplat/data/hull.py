"""Where the object is, from masks alone: a sphere that encloses the visual hull.

The visual hull (Laurentini 1994) is the set of points that fall inside the silhouette in every view; it contains the
object.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from etsplat.core.cameras import camera_centers
from etsplat.core.errors import InputError
from etsplat.data.dataset import Dataset
from etsplat.data.pictures import Pixels, as_float

_CELLS = 48
"""Grid cells per side, at each of the levels."""

_LEVELS = 3
"""Each level divides the box of what the one before has left."""

_MASK_WIDTH = 200
"""Silhouettes are shrunk to about this many pixels across (a pixel counts as inside if any part of it was)."""


def bounding_sphere(dataset: Dataset) -> tuple[Float[Tensor, "3"], float]:
    """A sphere that encloses the object: centred where the optical axes meet best, out to the visual hull.

    The hull is carved from a grid between the cameras with the masks of the training views. A view whose silhouette
    keeps off the image border shows the whole object, so it also excludes what its image does not show; where the
    silhouette is cut by the border, nothing is known outside the image. A point of the hull is judged by at least
    half of the views.

    Args:
        dataset: photos with alpha, in any frame.

    Returns:
        center (3,) and radius, in the frame of the cameras.

    Raises:
        InputError: no masks; a view that sees nothing of the object or nothing else; axes that do not meet in front
            of the cameras; silhouettes that have no common point; a camera inside the hull.
    """
    names = [dataset.names[index] for index in dataset.train]
    steps = np.array([max(1, dataset.images.sizes[index][0] // _MASK_WIDTH) for index in dataset.train])
    inside = _silhouettes(dataset, names, steps)
    rounded = dataset.viewmats[dataset.train].float()  # as the cameras have them
    viewmats, center = rounded.double().numpy(), axes_meeting_point(rounded)
    meeting = center.numpy()
    depth = viewmats[:, 2, :3] @ meeting + viewmats[:, 2, 3]
    if (depth <= 0).any():
        raise InputError(
            f"view {names[depth.argmin()]}: looks away from where the others look; an object needs views around it"
        )
    outside = [np.asarray(distance_transform_edt(~mask)) for mask in inside]
    Ks = dataset.Ks[dataset.train].float().double().numpy()
    Ks[:, :2] /= steps[:, None, None]
    carver = _Carver(viewmats, Ks, outside)
    eyes = camera_centers(rounded).double().numpy()
    kept, cell = _carve(carver, meeting, np.linalg.norm(eyes - meeting, axis=1).max())
    within = carver.keeps(eyes, 0.0)
    if within.any():
        raise InputError(f"view {names[within.argmax()]}: its camera is inside the object; remove that view")
    radius = float(np.linalg.norm(kept - meeting, axis=1).max()) + cell * 3**0.5 / 2
    return center.float(), radius


def _carve(carver: "_Carver", center: np.ndarray, reach: float) -> tuple[np.ndarray, float]:
    """Centres (N, 3) and side of the cubes that are left of the box `center` +- `reach`."""
    lower, upper = center - reach, center + reach
    kept, cell = center[None], reach
    for _ in range(_LEVELS):
        cell = float((upper - lower).max()) / _CELLS
        points = _grid(lower, upper, cell)
        kept = points[carver.keeps(points, cell)]
        if len(kept) == 0:
            raise InputError(
                "masks: the silhouettes have no point in common; check that masks are white inside the object and that"
                " poses and images belong together"
            )
        lower, upper = kept.min(axis=0) - cell / 2, kept.max(axis=0) + cell / 2
    return kept, cell


def axes_meeting_point(viewmats: Float[Tensor, "B 4 4"]) -> Float[Tensor, "3"]:
    """The point with the least sum of squared distances to the cameras' optical axes, float64.

    For an axis through c along the unit vector d the distance is |(I - d d^T)(x - c)|, so x solves
    sum(I - d d^T) x = sum(I - d d^T) c.

    Raises:
        InputError: the axes are parallel (or there is one camera).
    """
    rotations, translations = viewmats[:, :3, :3].double(), viewmats[:, :3, 3].double()
    centers = -(rotations.mT @ translations[..., None])[..., 0]
    directions = rotations[:, 2]
    projectors = torch.eye(3, dtype=torch.float64) - directions[:, :, None] * directions[:, None, :]
    system = projectors.sum(dim=0)
    if float(torch.linalg.eigvalsh(system)[0]) < 1e-4 * len(viewmats):
        raise InputError("cameras: their axes are parallel and meet nowhere; photograph the object from around it")
    return torch.linalg.solve(system, (projectors @ centers[..., None]).sum(dim=0)[:, 0])


def _silhouettes(dataset: Dataset, names: list[str], steps: np.ndarray) -> list[np.ndarray]:
    """Masks of the training views, each so many times smaller; a pixel is inside if any of those in it was."""
    masks = [_alpha(dataset.images[index]) for index in dataset.train]
    empty = [name for name, mask in zip(names, masks, strict=True) if not mask.any()]
    if empty:
        raise InputError(f"view {empty[0]}: its mask is empty, it sees nothing of the object; remove the view")
    full = [name for name, mask in zip(names, masks, strict=True) if mask.all()]
    if len(full) == len(names):
        raise InputError(
            "masks: the images have neither transparency nor masks, so the object cannot be told from its background;"
            " add a folder masks/ with a white-on-black picture for every image"
        )
    if full:
        raise InputError(
            f"view {full[0]}: its mask covers the whole image; the mask is missing, or the camera is inside or too near"
            " the object: add the mask or remove the view"
        )
    return [_any_of(mask, step) for mask, step in zip(masks, steps, strict=True)]


def _alpha(image: Pixels) -> np.ndarray:
    """(H, W) whether a pixel is inside: everywhere without an alpha channel."""
    return as_float(image[..., 3]).numpy() >= 0.5 if image.shape[-1] == 4 else np.ones(image.shape[:2], dtype=bool)


def _any_of(mask: np.ndarray, step: int) -> np.ndarray:
    rows, columns = (np.arange(0, size, step) for size in mask.shape)
    return np.logical_or.reduceat(np.logical_or.reduceat(mask, rows), columns, axis=1)


@dataclass
class _Carver:
    """Tests points against all silhouettes, in numpy: for thousands of small steps torch's threads are in the way.

    Attributes:
        viewmats: (B, 4, 4) float64.
        Ks: (B, 3, 3) float64, for the shrunk silhouettes.
        outside: B times (h, w), distance of each pixel to the silhouette, in pixels, 0 inside.
    """

    viewmats: np.ndarray
    Ks: np.ndarray
    outside: list[np.ndarray]

    def keeps(self, points: np.ndarray, cell: float) -> np.ndarray:
        """(N,) whether the cube of side `cell` about each point may reach into the silhouettes of all that judge it."""
        alive = np.arange(len(points))
        judged = np.zeros(len(points), dtype=np.int32)
        for viewmat, K, outside in zip(self.viewmats, self.Ks, self.outside, strict=True):
            camera = points[alive] @ viewmat[:3, :3].T + viewmat[:3, 3]
            z = camera[:, 2]
            front = z > 0
            pixel = (camera[:, :2] / np.where(front, z, 1)[:, None]) * K.diagonal()[:2] + K[:2, 2]
            framed = front & ((pixel >= 0) & (pixel < outside.shape[::-1])).all(axis=1)
            column, row = pixel[framed].astype(np.int64).T
            # Half the cube's diagonal on the screen, and half a pixel's.
            reach = K[0, 0] * 0.87 * cell / z[framed] + 0.71
            whole = min(edge.min() for edge in (outside[0], outside[-1], outside[:, 0], outside[:, -1])) > 0
            keep = np.full(len(alive), not whole)
            keep[framed] = outside[row, column] <= reach
            judged[alive] += framed | whole
            alive = alive[keep]
        kept = np.zeros(len(points), dtype=bool)
        kept[alive] = 2 * judged[alive] >= len(self.viewmats)
        return kept


def _grid(lower: np.ndarray, upper: np.ndarray, cell: float) -> np.ndarray:
    """(N, 3) centres of the cubes of side `cell` that fill the box."""
    axes = [np.arange(lower[k] + cell / 2, upper[k], cell) for k in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
