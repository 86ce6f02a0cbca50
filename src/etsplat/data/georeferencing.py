"""Captures with coordinates of maps: brought near the origin in float64, and where they lie written down."""

from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.data.frames import LARGEST, Frame, Listing
from etsplat.io.georeference import GEOREFERENCE_FILE, Georeference

_AFAR = 10_000.0
"""From the origin, in the capture's units: there float32 has steps of a thousandth."""

_AFAR_OF_SPREAD, _NEAR_OF_SPREAD = 168.0, 10.0
"""Times the spread of the cameras: from the one on steps are 1e-5 of it; within the other nothing is moved."""

_ROUNDING = 1e-6
"""Of the distance from the origin: so far apart are places that were one, where poses are written with few digits."""


def near_origin(scene: Path, listing: Listing) -> Listing:
    """The same, moved by whole units if its cameras are so far from the origin that float32 would be coarse.

    What is in `georeference.json` of the scene, or else what its layout says, and by how much it was moved, is in the
    listing's `georeference`.

    Raises:
        InputError: georeference.json is damaged.
    """
    path = scene / GEOREFERENCE_FILE
    given = Georeference.read(path) if path.is_file() else listing.georeference
    shift = _shift(listing)
    if shift is None:
        return replace(listing, georeference=given)
    x, y, z = shift.tolist()
    points = listing.points
    note = (
        f"coordinates are relative to ({x:.15g}, {y:.15g}, {z:.15g}): {GEOREFERENCE_FILE} of the run says where that is"
    )
    return replace(
        listing,
        frames=[replace(frame, viewmat=_moved(frame, shift)) for frame in listing.frames],
        points=None if points is None else (points[0] - shift, points[1]),
        notes=(*listing.notes, note),
        georeference=(given or Georeference()).after((x, y, z)),
    )


def middle_and_spread(centers: Float[Tensor, "B 3"]) -> tuple[Float[Tensor, "3"], float]:
    """The mean of camera positions and the largest distance from it; 0 if they are at one place but for rounding."""
    middle = centers.mean(dim=0)
    spread = float((centers - middle).norm(dim=1).max())
    return middle, spread if spread > _ROUNDING * float(middle.norm()) else 0.0


def _shift(listing: Listing) -> Float[Tensor, "3"] | None:
    """To where the origin goes: the mean of the cameras in whole units; None if it stays."""
    if not listing.frames:
        return None
    stacked = torch.stack([frame.viewmat for frame in listing.frames])
    if not float(stacked.abs().max()) <= LARGEST:  # which is reported later
        return None
    # By the inverse: rotations are only as right as the digits that were written of them.
    centers = -torch.linalg.solve(stacked[:, :3, :3], stacked[:, :3, 3:])[..., 0]
    middle, spread = middle_and_spread(centers)
    distance = float(middle.norm())
    if distance > _AFAR_OF_SPREAD * spread > 0 or (distance > _AFAR and distance > _NEAR_OF_SPREAD * spread):
        return middle.round() + 0.0  # which is no -0
    return None


def _moved(frame: Frame, shift: Float[Tensor, "3"]) -> Float[Tensor, "4 4"]:
    """World to camera, of the world whose origin is `shift`."""
    viewmat = frame.viewmat.clone()
    viewmat[:3, 3] += viewmat[:3, :3] @ shift
    return viewmat
