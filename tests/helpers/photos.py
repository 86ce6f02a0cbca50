"""Photos as phones write them: on their side, with EXIF."""

from pathlib import Path

import numpy as np
from PIL import ExifTags, Image

STORED_AS = {
    1: None,
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_90,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_270,
}
"""What makes the stored pixels of an upright image, by the tag Orientation (EXIF 2.32, table of 4.6.5)."""


def exif_bytes(
    orientation: int = 1,
    model: str = "",
    focal_mm: float = 0,
    focal_35mm: int = 0,
    gps: dict[int, object] | None = None,
) -> bytes:
    """EXIF with these tags; those of GPS by their numbers."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    if model:
        exif[ExifTags.Base.Model] = model
    details = exif.get_ifd(ExifTags.IFD.Exif)
    if focal_mm:
        details[ExifTags.Base.FocalLength] = focal_mm
    if focal_35mm:
        details[ExifTags.Base.FocalLengthIn35mmFilm] = focal_35mm
    if gps:
        exif.get_ifd(ExifTags.IFD.GPSInfo).update(gps)
    return exif.tobytes()


def upright_picture(width: int = 40, height: int = 24) -> Image.Image:
    """A different colour in every corner, smooth enough that JPEG keeps it."""
    rows, columns = np.mgrid[:height, :width] / [[[height - 1]], [[width - 1]]]
    pixels = np.stack([255 * rows, 255 * columns, 255 * rows * columns], axis=2)
    return Image.fromarray(pixels.round().astype(np.uint8))


def write_phone_photo(path: Path, upright: Image.Image, orientation: int = 1, **tags: float | str) -> None:
    """Stores an upright picture as its orientation says."""
    path.parent.mkdir(parents=True, exist_ok=True)
    turn = STORED_AS[orientation]
    stored = upright if turn is None else upright.transpose(turn)
    exif = exif_bytes(orientation, **tags)  # pyright: ignore[reportArgumentType]
    if path.suffix == ".heic":
        import pillow_heif

        pillow_heif.from_pillow(stored).save(path, exif=exif, quality=90)
    else:
        stored.save(path, exif=exif, quality=98, subsampling=0)
