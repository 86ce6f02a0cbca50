"""Photos as cameras and phones write them: JPEG, PNG and HEIC (pillow-heif, an extra), turned as their EXIF says."""

from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from etsplat.core.errors import InputError
from etsplat.io.atomic import atomic_write
from etsplat.io.exif import GpsPlace, TakenWith, on_its_side, place_of, taken_with, turn_of, upright_exif
from etsplat.io.images import IMAGE_FORMATS, IMAGE_SUFFIXES, decoded_as, open_image
from etsplat.io.paths import kind_of

HEIC_SUFFIXES = (".heic", ".heif")
PHOTO_SUFFIXES = (*IMAGE_SUFFIXES, *HEIC_SUFFIXES)
VIDEO_SUFFIXES = (".avi", ".m4v", ".mkv", ".mov", ".mp4", ".webm")
ARCHIVE_SUFFIXES = (".7z", ".bz2", ".gz", ".r3d", ".rar", ".tar", ".tgz", ".xz", ".zip")
UNREAD_SUFFIXES = (".webp", ".tif", ".tiff", ".avif", ".jxl", ".bmp", ".gif", ".dng", ".cr2", ".cr3", ".nef", ".arw")
"""File name endings, lower case: of photos, of videos, of archives, and of pictures that are not read."""

_QUALITY = 95


@dataclass(frozen=True)
class PhotoFile:
    """What is known of a photo without decoding it.

    Attributes:
        size: (width, height), upright.
        upright: whether its pixels are stored upright, in a file that other programs read too.
        taken_with: its camera, as far as it says.
        place: where it was taken, if it says so.
    """

    size: tuple[int, int]
    upright: bool
    taken_with: TakenWith
    place: GpsPlace | None = None


def open_photo(path: Path | str) -> Image.Image:
    """A photo that is not decoded yet; HEIC comes upright from its decoder.

    Raises:
        InputError: as `open_image`; or it is HEIC and pillow-heif is missing.
    """
    if kind_of(path) not in HEIC_SUFFIXES:
        return open_image(path)
    try:
        import pillow_heif
    except ImportError as error:
        raise InputError(f"image {path}: HEIC needs pillow-heif: pip install 'etsplat[heic]'") from error
    pillow_heif.register_heif_opener(thumbnails=False)
    return open_image(path, formats=(*IMAGE_FORMATS, "HEIF"))  # some are JPEG by another name


def inspect_photo(path: Path | str) -> PhotoFile:
    """Raises InputError as `open_photo`."""
    with open_photo(path) as image:
        size = (image.height, image.width) if on_its_side(image) else image.size
        upright = kind_of(path) in IMAGE_SUFFIXES and turn_of(image) is None
        return PhotoFile(size, upright, taken_with(image), place_of(image))


def write_upright(path: Path | str, target: Path) -> None:
    """Writes a photo anew as JPEG or PNG, upright, with the EXIF that it has. Atomic.

    Args:
        path: of the photo.
        target: ends in .jpg, .jpeg or .png.

    Raises:
        InputError: as `open_photo`; it is damaged; or it cannot be written.
    """
    with open_photo(path) as image:
        size, turn, exif = image.size, turn_of(image), upright_exif(image)
        pixels = decoded_as(image, path, "RGB")
    if pixels.size != size:  # as HEIC may, where a part of it that says so is damaged
        raise InputError(
            f"image {path}: damaged (says {size[0]}x{size[1]}, is {pixels.width}x{pixels.height}); copy it again"
        )
    if turn is not None:
        pixels = pixels.transpose(turn)
    kind = "PNG" if kind_of(target) == ".png" else "JPEG"
    with atomic_write(target) as temporary:
        pixels.save(temporary, kind, quality=_QUALITY, subsampling=0, exif=exif)  # PNG ignores the first two


def file_remedy(path: Path) -> str:
    """The end of the error for a photo, a video or an archive that stands where a capture belongs, or ""."""
    if not path.is_file():
        return ""
    if kind_of(path) in PHOTO_SUFFIXES:
        return "is one photo; name the folder that has all of them and their cameras"
    if kind_of(path) in VIDEO_SUFFIXES:
        return f"is a video; make a scene of it: etsplat data sfm {path} --out SCENE"
    if kind_of(path) in ARCHIVE_SUFFIXES:
        return "is an archive; unpack it and name the folder"
    return ""
