"""Captures whose photos say where they were taken: believed where that is exact beside their spread."""

import math

import pytest
import torch

from etsplat.data.gps_alignment import fit_to_map
from etsplat.geometry.map_coordinates import utm
from etsplat.io.exif import GpsPlace

METRES_NORTH = 1 / 111_200
"""Degrees of latitude that a metre is, about."""

EAST, NORTH = torch.meshgrid(torch.arange(0, 60, 12.0), torch.arange(0, 40, 10.0), indexing="ij")
FLIGHT = torch.stack([EAST.flatten(), NORTH.flatten(), 60 + 3 * torch.rand(20, generator=torch.manual_seed(1))], dim=1)
"""Metres: a flight over a field."""


def places(metres, noise=0.0, latitude=46.84, longitude=-91.99):
    """Where such photos say that they were taken."""
    metres = metres + noise * torch.randn(metres.shape, generator=torch.manual_seed(2))
    wide = METRES_NORTH / math.cos(math.radians(latitude))
    return [GpsPlace(latitude + METRES_NORTH * y, longitude + wide * x, z) for x, y, z in metres.tolist()]


def turned(metres, scale=0.1):
    """As structure from motion gives them: in a frame and a unit of their own."""
    rotation, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.manual_seed(3)))
    rotation = rotation * torch.linalg.det(rotation)
    return scale * (metres.double() @ rotation.T) + 5, rotation


@pytest.mark.parametrize(("latitude", "crs"), [(46.84, "EPSG:32615"), (-33.9, "EPSG:32715")])
def test_a_flight_is_turned_upright_and_gets_metres_and_a_place(latitude, crs):
    """Although every seventh photo kept the fix of one before it and others are a third of a metre off."""
    centers, rotation = turned(FLIGHT)
    told = places(FLIGHT, noise=0.3, latitude=latitude)
    told[7], told[14] = told[0], told[3]
    fit = fit_to_map(centers, told)
    assert fit is not None
    assert fit.believed
    assert (fit.crs, fit.count) == (crs, 20)
    assert fit.error < 0.6
    assert fit.to_map.scale == pytest.approx(10, rel=0.02)
    up = fit.to_map.rotation @ rotation @ torch.tensor([0.0, 0, 1], dtype=torch.float64)
    assert math.degrees(math.acos(float(up[2]))) < 2
    east, north = utm(latitude, -91.99, 15, latitude < 0)
    middle = centers.mean(dim=0)
    place = fit.georeference(middle)
    assert (place.up, place.crs, place.scale) == ("z", crs, fit.to_map.scale)
    mean = FLIGHT.double().mean(dim=0) + torch.tensor([east, north, 0.0], dtype=torch.float64)
    assert (torch.tensor(place.offset, dtype=torch.float64) - mean).norm() < 1.5
    turn = fit.turn_about(middle)
    world = torch.tensor(place.offset, dtype=torch.float64) + place.scale * turn.apply(centers)
    torch.testing.assert_close(world, fit.to_map.apply(centers), atol=1e-6, rtol=0)


def test_what_is_nearer_than_fixes_are_exact_is_left_as_it_is():
    """A walk of two metres around a stump, with the fixes of a phone; and one straight line, which may roll."""
    angle = torch.arange(12) * (2 * math.pi / 12)
    walk = torch.stack([2 * angle.cos(), 2 * angle.sin(), 1.5 + 0 * angle], dim=1)
    near = fit_to_map(turned(walk)[0], places(walk, noise=2.0))
    assert near is not None
    assert not near.believed
    line = FLIGHT * torch.tensor([1.0, 0.0, 0.0])
    straight = fit_to_map(turned(line)[0], places(line, noise=0.3))
    assert straight is not None
    assert not straight.believed


def test_nothing_is_concluded_from_few_places_one_place_or_the_poles():
    centers = turned(FLIGHT)[0]
    told = places(FLIGHT)
    assert fit_to_map(centers, [*told[:4], *[None] * 16]) is None
    assert fit_to_map(centers, [*told[:5], *[None] * 15]) is not None
    assert fit_to_map(centers, [told[0]] * 20) is None
    assert fit_to_map(torch.zeros(20, 3), told) is None
    assert fit_to_map(centers, places(FLIGHT, latitude=86.0)) is None
