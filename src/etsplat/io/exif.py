"""What a photo says of how it was taken: which way up, where, and with which camera at which focal length (EXIF).

Tags that cannot be read count as not there: programs write odd ones, and the pixels are as good without.
"""

import math
import warnings
from dataclasses import dataclass

from PIL import ExifTags, Image

# What it says of damaged tags helps nobody here; a filter for a while would not do, as threads share filters.
warnings.filterwarnings("ignore", category=UserWarning, module=r"PIL\.TiffImagePlugin")

_TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
"""What makes an image upright, by its tag Orientation."""

_ON_THEIR_SIDE = (5, 6, 7, 8)


@dataclass(frozen=True)
class TakenWith:
    """What tells one camera from another.

    Attributes:
        make: who made the camera; empty where the photo does not say.
        model: its name; empty where the photo does not say.
        focal_mm: focal length in millimetres; 0 where the photo does not say.
        focal_35mm: the same as of a film of 36 x 24 mm; 0 where the photo does not say.
    """

    make: str
    model: str
    focal_mm: float
    focal_35mm: float


@dataclass(frozen=True)
class GpsPlace:
    """Where a photo was taken, by WGS 84.

    Attributes:
        latitude: degrees, north is positive.
        longitude: degrees, east is positive.
        altitude: metres above the sea.
    """

    latitude: float
    longitude: float
    altitude: float


def turn_of(image: Image.Image) -> Image.Transpose | None:
    """What makes an image upright; None where it is, or does not say. Decodes nothing."""
    return _TURNS.get(_orientation(image))


def on_its_side(image: Image.Image) -> bool:
    """Whether width and height change places where an image is turned upright. Decodes nothing."""
    return _orientation(image) in _ON_THEIR_SIDE


def taken_with(image: Image.Image) -> TakenWith:
    """The camera of a photo. Decodes nothing."""
    exif = _exif_of(image)
    details = _details_of(exif)
    return TakenWith(
        _text(exif.get(ExifTags.Base.Make)),
        _text(exif.get(ExifTags.Base.Model)),
        _positive(details.get(ExifTags.Base.FocalLength)),
        _positive(details.get(ExifTags.Base.FocalLengthIn35mmFilm)),
    )


def place_of(image: Image.Image) -> GpsPlace | None:
    """Where a photo was taken; None where it does not say so whole, height included. Decodes nothing."""
    try:
        gps = _exif_of(image).get_ifd(ExifTags.IFD.GPSInfo)
        latitude = _degrees(gps[ExifTags.GPS.GPSLatitude], str(gps[ExifTags.GPS.GPSLatitudeRef]), "NS")
        longitude = _degrees(gps[ExifTags.GPS.GPSLongitude], str(gps[ExifTags.GPS.GPSLongitudeRef]), "EW")
        below = gps.get(ExifTags.GPS.GPSAltitudeRef) in (1, b"\x01")
        altitude = float(gps[ExifTags.GPS.GPSAltitude]) * (-1 if below else 1)
    except Exception:  # whatever parsing runs into
        return None
    on_earth = abs(latitude) <= 90 and abs(longitude) <= 180 and abs(altitude) < 100_000
    return GpsPlace(latitude, longitude, altitude) if on_earth and (latitude, longitude) != (0, 0) else None


def upright_exif(image: Image.Image) -> bytes:
    """The EXIF of an image for its upright copy; empty where it has none, or none that can be written again."""
    exif = _exif_of(image)
    exif.pop(ExifTags.Base.Orientation, None)
    try:
        return exif.tobytes() if len(exif) else b""
    except Exception:  # whatever writing odd tags runs into
        return b""


def _orientation(image: Image.Image) -> int:
    value = _exif_of(image).get(ExifTags.Base.Orientation)
    return value if isinstance(value, int) else 1


def _exif_of(image: Image.Image) -> Image.Exif:
    # Not image.getexif(): of a PNG without EXIF that decodes the pixels to look behind them.
    exif = Image.Exif()
    try:
        exif.load(image.info.get("exif") or b"")
        exif.get(ExifTags.Base.Orientation)  # tags are parsed when asked for
        dict(exif)
    except Exception:  # whatever parsing runs into
        return Image.Exif()
    return exif


def _details_of(exif: Image.Exif) -> dict[int, object]:
    try:
        return dict(exif.get_ifd(ExifTags.IFD.Exif))
    except Exception:  # whatever parsing runs into
        return {}


def _degrees(parts: tuple[float, ...], side: str, sides: str) -> float:
    """Of degrees, minutes and seconds on one of two sides; raises what odd tags lead to."""
    degrees, minutes, seconds = map(float, parts)
    return (1, -1)[sides.index(side.strip("\0 ").upper()[0])] * (degrees + minutes / 60 + seconds / 3600)


def _text(value: object) -> str:
    return "".join(c for c in value if c.isprintable()).strip()[:100] if isinstance(value, str) else ""


def _positive(value: object) -> float:
    """A number of millimetres that a lens can have; 0 for anything else."""
    try:
        number = float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return 0.0
    return number if math.isfinite(number) and 0.1 <= number <= 10_000 else 0.0
