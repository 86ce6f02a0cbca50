"""Cameras of photos that say where they were taken (GPS in their EXIF): turned so that z is up, and put on a map.

A fix is metres off, and photos of one walk are off together. So what all of them say is believed only where it is
small beside the way that was gone; a capture of a table, or of a walk around a statue, keeps the axes that it has.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.geometry.map_coordinates import FARTHEST_NORTH, FARTHEST_SOUTH, utm, utm_crs, utm_zone
from etsplat.geometry.similarity import Similarity
from etsplat.io.exif import GpsPlace
from etsplat.io.georeference import Georeference

LEAST_PLACES = 5
"""So many photos say where they were taken, or nothing is concluded: a similarity has seven numbers, three photos
give nine."""

LARGEST_ERROR = 0.05
"""Median distance of the photos from where they say they are, at most, in parts of their spread across the line along
which they spread most: about the angle, in radians, by which up may be wrong."""

_LEAST_SPREAD = 1.0
"""Metres: what lies nearer together is one place for GPS."""

_ROUNDS = 100


@dataclass(frozen=True)
class MapFit:
    """How cameras lie on a map.

    Attributes:
        to_map: from the cameras' frame to metres east, north and up.
        crs: the map's coordinate system.
        error: median distance in metres from where photos say that they are.
        across: root mean square of the cameras' distances in metres from the line along which they spread most.
        count: of photos that say where they are.
    """

    to_map: Similarity
    crs: str
    error: float
    across: float
    count: int

    @property
    def believed(self) -> bool:
        """Whether the photos contradict each other little enough to turn the capture by them."""
        return self.error <= LARGEST_ERROR * self.across

    def turn_about(self, middle: Float[Tensor, "3"]) -> Similarity:
        """What makes the axes of the cameras' frame east, north and up and `middle` its origin; lengths stay."""
        rotation = self.to_map.rotation
        return Similarity(rotation, 1.0, -(rotation @ middle.double()))

    def georeference(self, middle: Float[Tensor, "3"]) -> Georeference:
        """Of the frame that `turn_about` leads to."""
        x, y, z = self.to_map.apply(middle).tolist()
        return Georeference((x, y, z), self.to_map.scale, "z", self.crs)


def fit_to_map(centers: Float[Tensor, "P 3"], places: Sequence[GpsPlace | None]) -> MapFit | None:
    """Where cameras lie on the UTM map of their middle; photos that are far off count little.

    Args:
        centers: of the cameras.
        places: where each says that it was; None where it does not.

    Returns:
        None where fewer than `LEAST_PLACES` photos say so, where all were at one place, and near the poles.
    """
    told = [(center, place) for center, place in zip(centers.double(), places, strict=True) if place is not None]
    if len(told) < LEAST_PLACES:
        return None
    latitudes, longitudes = ([getattr(place, name) for _, place in told] for name in ("latitude", "longitude"))
    if not all(FARTHEST_SOUTH <= latitude <= FARTHEST_NORTH for latitude in latitudes):
        return None
    zone, south = utm_zone(sorted(longitudes)[len(told) // 2]), sorted(latitudes)[len(told) // 2] < 0
    wanted = torch.tensor(
        [[*utm(place.latitude, place.longitude, zone, south), place.altitude] for _, place in told],
        dtype=torch.float64,
    )
    if float((wanted - wanted.mean(dim=0)).norm(dim=1).max()) < _LEAST_SPREAD:
        return None
    given = torch.stack([center for center, _ in told])
    fit = _robust_similarity(given, wanted)
    if fit is None:
        return None
    placed = fit.apply(given)
    spreads = torch.linalg.svdvals(placed - placed.mean(dim=0))
    error = float((placed - wanted).norm(dim=1).median())
    return MapFit(fit, utm_crs(zone, south), error, float(spreads[1:].norm()) / len(told) ** 0.5, len(told))


def _robust_similarity(given: Float[Tensor, "P 3"], wanted: Float[Tensor, "P 3"]) -> Similarity | None:
    """The one with the least sum of distances, by weighted least squares over and over (Weiszfeld's way)."""
    weights, fit = torch.ones(len(given), dtype=torch.float64), None
    for _ in range(_ROUNDS):
        fit = _similarity(given, wanted, weights)
        if fit is None:
            return None
        distances = (fit.apply(given) - wanted).norm(dim=1)
        weights = 1 / distances.clamp_min(1e-3 * float(distances.median()) + 1e-9)
    return fit


def _similarity(
    given: Float[Tensor, "P 3"], wanted: Float[Tensor, "P 3"], weights: Float[Tensor, " P"]
) -> Similarity | None:
    """The one with the least weighted sum of squared distances (Umeyama 1991); None where either is at one place."""
    weights = weights / weights.sum()
    middle, aim = weights @ given, weights @ wanted
    x, y = given - middle, wanted - aim
    variance = float(weights @ x.square().sum(dim=1))
    if variance <= 0:
        return None
    u, values, vt = torch.linalg.svd(y.T @ (weights[:, None] * x))
    signs = torch.ones(3, dtype=torch.float64)
    signs[2] = torch.sign(torch.linalg.det(u) * torch.linalg.det(vt))
    scale = float(values @ signs) / variance
    if not scale > 0:
        return None
    rotation = u @ torch.diag(signs) @ vt
    return Similarity(rotation, scale, aim - scale * (rotation @ middle))
