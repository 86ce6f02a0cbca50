"""Degrees on the globe as metres on a map: the transverse Mercator projection of UTM, on the ellipsoid of WGS 84.

By Krüger's series in the third flattening n, as C. F. F. Karney writes it ("Transverse Mercator with an accuracy of a
few nanometers", Journal of Geodesy 85, 2011); terms to the third power of n are exact to a tenth of a millimetre.
"""

import math

_AXIS, _FLATTENING = 6_378_137.0, 1 / 298.257223563
_SCALE, _EAST, _SOUTH = 0.9996, 500_000.0, 10_000_000.0
_N = _FLATTENING / (2 - _FLATTENING)
_RADIUS = _AXIS / (1 + _N) * (1 + _N**2 / 4 + _N**4 / 64)
_SERIES = (
    _N / 2 - 2 * _N**2 / 3 + 5 * _N**3 / 16,
    13 * _N**2 / 48 - 3 * _N**3 / 5,
    61 * _N**3 / 240,
)

FARTHEST_SOUTH, FARTHEST_NORTH = -80.0, 84.0
"""Degrees of latitude between which UTM is defined."""


def utm_zone(longitude: float) -> int:
    """The number of the zone, 1 to 60, that a longitude in degrees lies in; Norway's and Svalbard's wide ones are not.

    Example:
        >>> utm_zone(13.4)
        33
    """
    return math.floor((longitude + 180) / 6) % 60 + 1


def utm_crs(zone: int, south: bool) -> str:
    """The name of a zone's coordinate system.

    Example:
        >>> utm_crs(33, south=False)
        'EPSG:32633'
    """
    return f"EPSG:{(32700 if south else 32600) + zone}"


def utm(latitude: float, longitude: float, zone: int, south: bool) -> tuple[float, float]:
    """East and north in metres.

    Args:
        latitude: degrees, from `FARTHEST_SOUTH` to `FARTHEST_NORTH`.
        longitude: degrees.
        zone: of the map; neighbouring places may lie in the next one.
        south: whether the map is of the southern hemisphere.

    Example:
        >>> [round(metres, 2) for metres in utm(0.0, 3.0, 31, south=False)]
        [500000.0, 0.0]
    """
    away = math.radians((longitude - (6 * zone - 183) + 180) % 360 - 180)
    sine, root = math.sin(math.radians(latitude)), 2 * math.sqrt(_N) / (1 + _N)
    conformal = math.sinh(math.atanh(sine) - root * math.atanh(root * sine))
    xi, eta = math.atan2(conformal, math.cos(away)), math.asinh(math.sin(away) / math.hypot(conformal, math.cos(away)))
    east, north = eta, xi
    for j, factor in enumerate(_SERIES, 1):
        east += factor * math.cos(2 * j * xi) * math.sinh(2 * j * eta)
        north += factor * math.sin(2 * j * xi) * math.cosh(2 * j * eta)
    return _EAST + _SCALE * _RADIUS * east, (_SOUTH if south else 0.0) + _SCALE * _RADIUS * north
