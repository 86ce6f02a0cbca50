"""A folder of photos, as its owner has it, becomes what COLMAP reads: upright JPEG and PNG, sorted by their cameras."""

import os
import shutil
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal

from etsplat.core.errors import InputError
from etsplat.data.frames import MASK_FOLDER, MASK_SUFFIX
from etsplat.io.images import IMAGE_SUFFIXES, load_rgb
from etsplat.io.paths import kind_of, path_remedy
from etsplat.io.photos import PHOTO_SUFFIXES, UNREAD_SUFFIXES, PhotoFile, file_remedy, inspect_photo, write_upright

CameraSharing = Literal["auto", "folder", "photo"]
"""Which photos have one camera: those that say the same of camera and focal length, or else are of one subfolder; those
of one subfolder; or none. Photos of different sizes never do."""

LEAST_COUNT = 3


@dataclass(frozen=True)
class Photo:
    """A photo of a folder.

    Attributes:
        path: the file.
        name: of its copy that COLMAP reads, relative to the folder, with forward slashes.
        file: what is known of it.
    """

    path: Path
    name: str
    file: PhotoFile


def list_photos(folder: Path) -> list[Photo]:
    """The photos in a folder and its subfolders, in order of their names; what is hidden is left alone, and masks.

    Raises:
        InputError: no such folder; fewer than three photos; one cannot be opened; two would have one name.
    """
    if folder.is_file() and kind_of(folder) in PHOTO_SUFFIXES:
        raise InputError(f"photos {folder}: is one photo; name the folder that has all of them")
    if folder.is_file():
        raise InputError(f"photos {folder}: {file_remedy(folder) or 'is a file; name the folder of the photos'}")
    if not folder.is_dir():
        raise InputError(f"photos {folder}: no such file or folder; {path_remedy(folder)}")
    paths = sorted(path for path in folder.rglob("*") if kind_of(path) in PHOTO_SUFFIXES and path.is_file())
    shown = [path for path in paths if not any(part.startswith(".") for part in path.relative_to(folder).parts)]
    shown = _without_masks(shown, folder)
    if len(shown) < LEAST_COUNT:
        unread = unread_pictures(folder)
        others = (
            f", and {len(unread)} pictures of kinds that are not read: convert them to JPEG or PNG" if unread else ""
        )
        raise InputError(
            f"photos {folder}: {len(shown)} JPEG, PNG or HEIC files{others}; at least 3 are needed, better 20 or more"
        )
    photos: dict[str, Photo] = {}
    for path in shown:
        name = path.relative_to(folder)
        name = (name if kind_of(name) in IMAGE_SUFFIXES else name.with_suffix(".jpg")).as_posix()
        if name in photos:
            raise InputError(
                f"photos {folder}: {photos[name].path.name} and {path.name} would both be {name}; keep one of them"
            )
        photos[name] = Photo(path, name, inspect_photo(path))
    return list(photos.values())


def _without_masks(paths: list[Path], folder: Path) -> list[Path]:
    """All but those in `masks/`, if one of them is called as a photo is."""
    others = [path for path in paths if not path.is_relative_to(folder / MASK_FOLDER)]
    return others if brings_masks(folder, others) else paths


def brings_masks(folder: Path, photos: Iterable[Path]) -> bool:
    """Whether a folder of photos has `masks/` with a picture that is called as one of them is."""
    names = {name for path in photos for name in (path.name, path.stem)}
    masks = [path.stem for path in (folder / MASK_FOLDER).rglob("*") if kind_of(path) in IMAGE_SUFFIXES]
    return any(name in names or name.removesuffix(MASK_SUFFIX) in names for name in masks)


def unread_pictures(folder: Path) -> list[str]:
    """Names of pictures of kinds that are not read, but for those beside a photo of that name, as cameras write raw."""
    paths = [path.relative_to(folder) for path in folder.rglob("*") if not path.is_dir()]
    shown = [path for path in paths if not any(part.startswith(".") for part in path.parts)]
    photos = {path.with_suffix("") for path in shown if kind_of(path) in PHOTO_SUFFIXES}
    unread = (path for path in shown if kind_of(path) in UNREAD_SUFFIXES and path.with_suffix("") not in photos)
    return sorted(path.as_posix() for path in unread)


def take_in(photos: list[Photo], folder: Path, threads: int | None, report: Callable[[str, int, int], None]) -> None:
    """Puts photos into a folder by their names: links to those that are upright, upright copies of the others.

    All are decoded: of a photo that is cut short COLMAP takes what is there, and grey for the rest.

    Raises:
        InputError: a photo is damaged.
        OSError: it cannot be written.
    """
    for photo in photos:
        (folder / photo.name).parent.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(threads or os.cpu_count()) as pool:
        futures = [pool.submit(_take_in, photo, folder / photo.name) for photo in photos]
        try:
            for done, future in enumerate(futures):
                report("Reading photos", done, len(photos))
                future.result()
        finally:
            for future in futures:
                future.cancel()
    report("Reading photos", len(photos), len(photos))


def by_camera(photos: list[Photo], sharing: CameraSharing) -> list[list[str]]:
    """Names of photos, those with one camera together."""
    groups: dict[object, list[str]] = {}
    keys: Mapping[CameraSharing, Callable[[Photo], object]] = {
        "auto": _camera_of,
        "folder": lambda photo: PurePosixPath(photo.name).parent,
        "photo": lambda photo: photo.name,
    }
    for photo in photos:
        groups.setdefault((photo.file.size, keys[sharing](photo)), []).append(photo.name)
    return list(groups.values())


def _camera_of(photo: Photo) -> object:
    camera = photo.file.taken_with
    says = camera.model or camera.focal_mm or camera.focal_35mm
    return camera if says else PurePosixPath(photo.name).parent


def _take_in(photo: Photo, target: Path) -> None:
    if not photo.file.upright:
        write_upright(photo.path, target)
        return
    load_rgb(photo.path)
    try:
        target.symlink_to(photo.path.resolve())
    except OSError:  # a system or a disk without links
        shutil.copyfile(photo.path, target)
