"""What photos say of how they were taken, also where they say it badly."""

import io

import numpy as np
import pytest
from PIL import Image

from etsplat.io.exif import GpsPlace, TakenWith, on_its_side, place_of, taken_with, turn_of, upright_exif
from helpers.photos import STORED_AS, exif_bytes, upright_picture


def with_exif(exif: bytes, kind: str = "JPEG") -> Image.Image:
    memory = io.BytesIO()
    upright_picture().save(memory, kind, exif=exif)
    return Image.open(memory)


@pytest.mark.parametrize("kind", ["JPEG", "PNG"])
@pytest.mark.parametrize("orientation", STORED_AS)
def test_a_stored_picture_is_turned_upright(orientation, kind):
    """For each of the eight ways of storing one."""
    turn, stored_as = turn_of(with_exif(exif_bytes(orientation), kind)), STORED_AS[orientation]
    upright = upright_picture()
    stored = upright if stored_as is None else upright.transpose(stored_as)
    assert np.array_equal(np.asarray(stored if turn is None else stored.transpose(turn)), np.asarray(upright))
    assert on_its_side(with_exif(exif_bytes(orientation), kind)) == (stored.size != upright.size)


def test_the_camera_and_its_focal_length_are_read_and_kept_in_upright_copies():
    exif = exif_bytes(6, "Phone 7", 4.25, 28)
    expected = TakenWith("", "Phone 7", 4.25, 28.0)
    assert taken_with(with_exif(exif)) == expected
    copy = with_exif(upright_exif(with_exif(exif)))
    assert taken_with(copy) == expected
    assert turn_of(copy) is None
    assert upright_exif(Image.open(io.BytesIO(with_exif(b"").fp.getvalue()))) == b""  # pyright: ignore


PLACE = {1: "S", 2: (33.0, 54.0, 18.0), 3: "W", 4: (18.0, 24.0, 36.0), 5: b"\x01", 6: 3.5}
"""Tags of GPS: latitude, longitude and height below the sea."""


def test_where_a_photo_was_taken_is_read_and_kept_in_upright_copies():
    expected = GpsPlace(pytest.approx(-33.905), pytest.approx(-18.41), -3.5)  # pyright: ignore[reportArgumentType]
    image = with_exif(exif_bytes(6, gps=PLACE))
    assert place_of(image) == expected
    assert place_of(with_exif(upright_exif(image))) == expected
    above = place_of(with_exif(exif_bytes(gps={**PLACE, 1: "N", 3: "E", 5: b"\x00"})))
    assert above == GpsPlace(pytest.approx(33.905), pytest.approx(18.41), 3.5)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    "odd", [{6: None}, {1: None}, {1: "X"}, {2: (100.0, 0.0, 0.0)}, {2: (0.0, 0.0, 0.0), 4: (0.0, 0.0, 0.0)}]
)
def test_a_place_without_height_or_not_on_earth_is_none(odd):
    """Nor is 0 degrees north, 0 degrees east, which stands where a receiver had no fix."""
    tags = {number: value for number, value in {**PLACE, **odd}.items() if value is not None}
    assert place_of(with_exif(exif_bytes(gps=tags))) is None


@pytest.mark.filterwarnings("ignore")  # pytest does not know the filter of the module
def test_tags_that_make_no_sense_count_as_not_there():
    """Orientation 9, focal lengths of nothing, and EXIF cut short or full of noise, which leaves the picture usable."""
    assert turn_of(with_exif(exif_bytes(9))) is None
    assert taken_with(with_exif(exif_bytes(1, focal_mm=1e-9))).focal_mm == 0
    whole, rng = exif_bytes(6, "Phone 7", 4.25, 28, PLACE), np.random.default_rng(0)
    for _ in range(300):
        data = bytearray(whole[: int(rng.integers(7, len(whole) + 1))])
        for at in rng.integers(6, len(data), 3):
            data[at] = rng.integers(256)
        image = with_exif(bytes(data))
        assert turn_of(image) is None or turn_of(image) in STORED_AS.values()
        assert 0 <= taken_with(image).focal_mm <= 10_000
        upright_exif(image)
        place_of(image)
