"""Degrees as metres on the maps of UTM."""

import pytest

from etsplat.geometry.map_coordinates import utm, utm_crs, utm_zone


@pytest.mark.parametrize(
    ("latitude", "longitude", "zone", "south", "expected"),
    [
        (52.518918, 13.400295, 33, False, (391457.3794489, 5819958.8816355)),
        (-33.9, 18.4, 34, True, (259583.2216604, 6245888.0454407)),
        (83.9, 3.2, 31, False, (502372.7668825, 9316934.2718822)),
        (10.0, 7.5, 31, False, (993660.1201776, 1108784.0076029)),
        (60.0, 179.9, 1, False, (327131.3638775, 6655462.6839250)),
    ],
)
def test_places_are_where_proj_has_them(latitude, longitude, zone, south, expected):
    """PROJ 9 by pyproj 3.7; also in the next zone and across the line where the date changes. To a millimetre."""
    assert utm(latitude, longitude, zone, south) == pytest.approx(expected, abs=1e-3)


def test_zones_are_six_degrees_wide_and_have_names():
    assert [utm_zone(longitude) for longitude in (-180.0, -92.0, -0.1, 0.0, 13.4, 179.9, 180.0)] == [
        1,
        15,
        30,
        31,
        33,
        60,
        1,
    ]
    assert (utm_crs(33, south=False), utm_crs(9, south=True)) == ("EPSG:32633", "EPSG:32709")
