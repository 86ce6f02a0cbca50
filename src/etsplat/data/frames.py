"""What all layouts of scene folders share: frames (file, pose, intrinsics, mask), and the data set made of them."""

import hashlib
import os
import unicodedata
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.core.spelling import option
from etsplat.data.dataset import Dataset, every_eighth
from etsplat.data.pictures import LazyPictures, Picture
from etsplat.io.depth_maps import DEPTH_SUFFIXES, load_depth, resize_depth
from etsplat.io.georeference import Georeference
from etsplat.io.images import (
    IMAGE_SUFFIXES,
    image_size,
    load_image,
    load_mask,
    load_mask_pixels,
    load_pixels,
    premultiply,
    resize_image,
    size_for,
)
from etsplat.io.paths import kind_of, path_remedy, path_within
from etsplat.io.photos import HEIC_SUFFIXES, UNREAD_SUFFIXES

MAX_WIDTH = 1600
"""Wider images are shrunk to this width unless another is asked for, as 3DGS does."""

_SAMPLE = 4096
"""So many bytes of each file's beginning, middle and end, with its length, tell it from others."""

LARGEST = 1e18
"""Of all numbers of poses and cameras: float32 holds their squares."""

MASK_FOLDER, MASK_SUFFIX = "masks", "_mask"
"""Of a scene, with a mask for each image, called like it, or with this after its name."""

_NEARLY = 0.1
"""Parts of a photo's width by which a mask differs that is no copy of another size, made on purpose."""

DEPTH_FOLDERS = ("depths", "depth")
"""Of a scene, with a depth map for each image, called like it."""

MasksAs = Literal["ignore", "alpha"]

Points = tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]
"""Float64 positions in the units of the poses, and float32 colours in [0, 1] as displayed."""


@dataclass(frozen=True)
class Lens:
    """Distortion as COLMAP has it.

    Attributes:
        model: its name.
        coefficients: the model's parameters after the focal lengths and the principal point.
        told: what it is in words, for error messages.
    """

    model: str
    coefficients: tuple[float, ...]
    told: str


@dataclass(frozen=True)
class Frame:
    """One posed image of a scene.

    Attributes:
        name: path of the image as the scene names it, with forward slashes.
        image: the file.
        mask: its mask (white inside the object, or where pixels count), or None.
        viewmat: (4, 4) float64, world to camera, OpenCV axes.
        K: (3, 3) float64, pixels of an image of `size`.
        size: (width, height) that K refers to; the file may be a smaller or larger copy.
        lens: its distortion, which has to be removed before a data set is made of it; None without.
        depth: its depth map, or None.
        depth_unit: units of the capture in a step of the map's numbers; None for what its kind of file has.
    """

    name: str
    image: Path
    mask: Path | None
    viewmat: Float[Tensor, "4 4"]
    K: Float[Tensor, "3 3"]
    size: tuple[int, int]
    lens: Lens | None = None
    depth: Path | None = None
    depth_unit: float | None = None


@dataclass(frozen=True)
class Listing:
    """What the files of a scene say, before an image is opened.

    Attributes:
        frames: the posed images.
        split: (train, test) indices; None for every 8th frame as test, the frames being sorted by name.
        points: of the scene, in the frame of the poses; None without.
        notes: sentences about what is left out or not understood.
        georeference: where the frame of the poses lies in the world; None where nobody said so.
    """

    frames: Sequence[Frame]
    split: tuple[list[int], list[int]] | None = None
    points: Points | None = None
    notes: tuple[str, ...] = ()
    georeference: Georeference | None = None


@dataclass(frozen=True)
class Wanted:
    """What is wanted of a scene; as `etsplat.data.load.load_dataset` takes it."""

    masks_as: MasksAs = "ignore"
    images: str | None = None
    width: int | None = None
    masks: Path | None = None
    memory: int | None = None
    depths: bool | Path = False
    depth_unit: float | None = None

    def mask_of(self, scene: Path, name: str, source: Path) -> Path | None:
        """The mask of image `name`, which the file `source` names: in `masks`, or in the scene's own, if it has any.

        By the name with the folders in it, or else by its last part.

        Raises:
            InputError: the folder lacks it; or as `path_within`.
        """
        folder = self.masks or scene / MASK_FOLDER
        if self.masks is None and not folder.is_dir():
            return None
        with suppress(InputError):
            return find_mask(folder, name, source)
        return find_mask(folder, PurePosixPath(name).name, source)

    def depth_of(self, scene: Path, name: str, source: Path) -> Path | None:
        """The depth map of image `name`: in the folder `depths`, or in the scene's own; None if it has none.

        Raises:
            InputError: there is no such folder; or as `path_within`.
        """
        if self.depths is False:
            return None
        folders = [scene / own for own in DEPTH_FOLDERS] if self.depths is True else [self.depths]
        if self.depths is not True and not self.depths.is_dir():
            raise InputError(f"depths {self.depths}: no such folder; {path_remedy(self.depths)}")
        return next((found for folder in folders if (found := _spelled(folder, name, source, DEPTH_SUFFIXES))), None)


def pinhole(fx: float, fy: float, cx: float, cy: float) -> Float[Tensor, "3 3"]:
    """K of these, float64."""
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)


def posed(scene: Path, listing: Listing, wanted: Wanted) -> Dataset:
    """The data set of a scene's frames in its own units; no image has been decoded yet.

    Args:
        scene: its folder, for error messages.
        listing: what its files say.
        wanted: width and kind of the images.

    Raises:
        InputError: fewer than two frames, frames with one name, missing images, images of another shape than their
            camera, lens distortion, numbers beyond `LARGEST`.
    """
    frames, points = listing.frames, listing.points
    check_frames(scene, frames)
    for frame in frames:
        if frame.lens is not None:
            raise InputError(
                f"scene {scene}: {frame.name} has {frame.lens.told}; run `etsplat data undistort SCENE --out NEW`"
                " or `colmap image_undistorter`, and use the new folder"
            )
    if points is not None and not bool((points[0].abs() <= LARGEST).all()):
        raise InputError(f"scene {scene}: has points farther away than {LARGEST:g}; remove them")
    if len(frames) < 2:  # one to learn from, one to test
        raise InputError(f"scene {scene}: has {len(frames)} posed images; at least 2 are needed, better 20")
    Ks, sizes, whole = [], [], list[tuple[int, int]]()
    for frame in frames:
        whole.append(size := size_for(frame.image, frame.size))
        across = min(size[0], wanted.width or MAX_WIDTH)
        sizes.append((across, max(1, round(size[1] * across / size[0]))))
        Ks.append(scaled_intrinsics(scene, frame, size, sizes[-1]))
    files = [file for frame in frames for file in (frame.image, frame.mask, frame.depth) if file is not None]
    units = {frame.depth_unit for frame in frames if frame.depth is not None}
    pictures = LazyPictures(
        partial(_decoded, frames, sizes, wanted.masks_as),
        sizes,
        [_size_in_bytes(frame, size, wanted.masks_as) for frame, size in zip(frames, sizes, strict=True)],
        partial(_fingerprint, files, repr(sorted(map(str, units))) if units else ""),
        wanted.memory,
        [view for view, frame in enumerate(frames) if frame.depth is not None],
    )
    train, test = listing.split or every_eighth(len(frames))
    viewmats = torch.stack([frame.viewmat for frame in frames])
    names, (places, colors) = _view_names(frames), points or (None, None)
    return Dataset(
        *(viewmats, torch.stack(Ks), pictures, names, train, test, places, colors),
        notes=(*listing.notes, *_notes_on_masks(frames, whole)),
        georeference=listing.georeference,
    )


def _notes_on_masks(frames: Sequence[Frame], sizes: Sequence[tuple[int, int]]) -> list[str]:
    """A note where a mask has nearly the size of its photo: one of them alone may be free of lens distortion."""
    for frame, size in zip(frames, sizes, strict=True):
        with suppress(InputError):  # of a damaged file, which is told where it is read
            if frame.mask is None or (mask := image_size(frame.mask)) == size:
                continue
            if abs(mask[0] / size[0] - 1) < _NEARLY:
                told = f"{mask[0]}x{mask[1]}, its photo {size[0]}x{size[1]}"
                return [f"mask {frame.mask.name} is {told}: masks must be freed of lens distortion as photos are"]
    return []


def check_frames(scene: Path, frames: Sequence[Frame]) -> None:
    """Raises InputError where images are missing, two frames have one, or numbers cannot be meant."""
    if not frames:
        raise InputError(f"scene {scene}: has no posed images; at least 2 are needed, better 20")
    missing = [frame for frame in frames if not frame.image.is_file()]
    if missing:
        raise InputError(
            f"scene {scene}: {len(missing)} of {len(frames)} images are missing"
            f" (first: {missing[0].image}); {_missing_remedy(scene, missing[0].image, len(missing) == len(frames))}"
        )
    image, count = Counter(frame.image for frame in frames).most_common(1)[0]
    if count > 1:
        name = next(frame.name for frame in frames if frame.image == image)
        raise InputError(f"scene {scene}: {count} frames have the image {name}; keep one of them")
    for frame in frames:
        if not float(frame.K.diagonal()[:2].min()) >= 1 / LARGEST:
            raise InputError(
                f"scene {scene}: {frame.name} has a focal length that is not positive; export the poses again"
            )
        if not float(torch.cat([frame.K, frame.viewmat[:3, :3], frame.viewmat[:3, 3:].T]).abs().max()) <= LARGEST:
            raise InputError(
                f"scene {scene}: {frame.name} has a pose or camera with numbers beyond {LARGEST:g}; export them again"
            )
        if not all(1 <= side < 2**31 for side in frame.size):
            raise InputError(f"scene {scene}: the camera of {frame.name} has no size; export the poses again")


def _view_names(frames: Sequence[Frame]) -> list[str]:
    """Names fit for files: folders joined by underscores, endings dropped unless that made two alike.

    Where joining made two alike, a/b.jpg and a_b.jpg, all are numbered.
    """
    full = [frame.name.removeprefix("./").replace("/", "_") for frame in frames]
    short = [PurePosixPath(name).stem for name in full]
    numbered = [f"{index:04d}_{name}" for index, name in enumerate(full)]
    return next(names for names in (short, full, numbered) if len(set(names)) == len(names))


def _missing_remedy(scene: Path, image: Path, none: bool) -> str:
    """What to do about an image that is not there: it may lie there as a kind of file that is not read.

    Or in another folder of the scene, as 3DGS has them in input/, where `none` of them is there.
    """
    with suppress(OSError):  # folders that may not be read
        beside = [place for place in sorted(scene.iterdir()) if (place / image.name).is_file()] if none else []
        if beside:
            return f"they are in {beside[0].name}/, which {option('images', beside[0].name)} takes them from"
    other = _with_any_ending(image, (*HEIC_SUFFIXES, *UNREAD_SUFFIXES))
    if other is None:
        return "copy them there or remove their poses"
    return f"{other.name} is there, which is not read: convert it, and others like it, to JPEG or PNG"


def find_image(folder: Path, name: str, source: Path) -> Path:
    """The file of image `name` in a folder, or one that differs in its ending; as named if there is none.

    Raises:
        InputError: the name, which the file `source` gives, leads out of the folder.
    """
    return _spelled(folder, name, source) or folder / name


def find_mask(folder: Path, name: str, source: Path) -> Path:
    """The mask of image `name` in a folder: NAME itself, with another ending, or with .png added as COLMAP has it.

    Or NAME_mask, as Metashape calls it.

    Raises:
        InputError: there is none, or no folder; or the name, which the file `source` gives, leads out of it.
    """
    if not folder.is_dir():
        made = "`etsplat data masks SCENE --out SCENE/masks` makes them"
        remedy = made if folder.name == "auto" else path_remedy(folder)
        raise InputError(f"masks {folder}: no such folder; {remedy}")
    place = PurePosixPath(name)
    calls = [name, *([str(place.with_name(f"{place.stem}{MASK_SUFFIX}{place.suffix}"))] if place.name else [])]
    found = next((path for call in calls if (path := _spelled(folder, call, source)) is not None), None)
    if found is None:
        raise InputError(f"masks {folder}: no mask for image {name}; add {(folder / name).with_suffix('.png').name}")
    return found


def _spelled(folder: Path, name: str, source: Path, suffixes: Sequence[str] = IMAGE_SUFFIXES) -> Path | None:
    """The file `name` in a folder, with any of the endings; letters with marks may be one character there, or two.

    Raises:
        InputError: as `path_within`.
    """
    spellings = dict.fromkeys((name, unicodedata.normalize("NFC", name), unicodedata.normalize("NFD", name)))
    paths = [path_within(folder, spelling, source) for spelling in spellings]
    return next((found for path in paths if (found := _with_any_ending(path, suffixes))), None)


def _with_any_ending(path: Path, suffixes: Sequence[str]) -> Path | None:
    """The file at a path, or one with one of the endings, small or large, in place of its own or added to it."""
    endings = [ending for suffix in suffixes for ending in (suffix, suffix.upper())]
    candidates = [path, *(path.with_suffix(ending) for ending in endings), *(Path(f"{path}{s}") for s in endings)]
    return next((candidate for candidate in candidates if candidate.is_file()), None)


def check_copy(scene: Path, name: str, size: tuple[int, int], whole: tuple[int, int]) -> None:
    """Raises InputError where an image of `size` is no copy, smaller or larger, of the one that a camera is for."""
    scale = size[0] / whole[0]
    if abs(whole[1] * scale - size[1]) > min(2, 0.1 * size[1]):  # smaller copies are rounded to whole pixels
        raise InputError(
            f"scene {scene}: {name} is {size[0]}x{size[1]}, but its camera is for {whole[0]}x{whole[1]}; use the images"
            " that the poses were made from"
        )


def scaled_intrinsics(
    scene: Path, frame: Frame, size: tuple[int, int], target: tuple[int, int]
) -> Float[Tensor, "3 3"]:
    """K for images of `target` pixels, when the file has `size` and K refers to `frame.size`; float64.

    Raises:
        InputError: the file has another shape than K's image.
    """
    check_copy(scene, frame.name, size, frame.size)
    ratio = torch.tensor([target[0] / frame.size[0], target[1] / frame.size[1], 1.0], dtype=torch.float64)
    return frame.K * ratio[:, None]


def _size_in_bytes(frame: Frame, size: tuple[int, int], masks_as: MasksAs) -> int:
    """An upper bound: PNG files may turn out to have no transparency."""
    channels = (4 if kind_of(frame.image) == ".png" else 3) + (frame.mask is not None)
    depth = 0 if frame.depth is None else 4
    return size[0] * size[1] * ((16 if masks_as == "alpha" else channels) + depth)


def _bytes_and_mask(frame: Frame, size: tuple[int, int]) -> Picture:
    pixels = load_pixels(frame.image, *size)
    return Picture(pixels, None if frame.mask is None else load_mask_pixels(frame.mask, *size))


def _masked_rgba(frame: Frame, size: tuple[int, int]) -> Picture:
    """Shrunk in float, after the mask: a silhouette keeps its place to a part of a pixel."""
    image = premultiply(load_image(frame.image, frame.size))
    if frame.mask is not None:
        image = image * load_mask(frame.mask, (image.shape[1], image.shape[0]))[..., None]
    return Picture(image if size == (image.shape[1], image.shape[0]) else resize_image(image, *size))


def _depth(path: Path, unit: float | None, size: tuple[int, int]) -> Float[Tensor, "H W"]:
    """A depth map in the size of its photo; scanners' are often much smaller."""
    depth, (width, height) = load_depth(path, unit), size
    H, W = depth.shape
    if abs(H * width / W - height) > max(2, width / W):
        raise InputError(f"depth map {path}: is {W}x{H}, its image is {width}x{height}; resize or crop the map")
    return resize_depth(depth, width, height)


_DECODERS: dict[MasksAs, Callable[[Frame, tuple[int, int]], Picture]] = {
    "ignore": _bytes_and_mask,
    "alpha": _masked_rgba,
}


def _decoded(frames: Sequence[Frame], sizes: Sequence[tuple[int, int]], masks_as: MasksAs, view: int) -> Picture:
    """The photo of a view, with its depths. A function that other processes find by its name."""
    frame, size = frames[view], sizes[view]
    picture = _DECODERS[masks_as](frame, size)
    return picture if frame.depth is None else replace(picture, depth=_depth(frame.depth, frame.depth_unit, size))


def _fingerprint(files: Sequence[Path], units: str) -> bytes:
    """What the files hold, not when they were written: the same for a copy. Decodes nothing. Then units of depths."""
    digest = hashlib.sha256()
    with ThreadPoolExecutor() as pool:
        for sample in pool.map(_sample, files):
            digest.update(sample)
    return digest.digest() + units.encode()


def _sample(path: Path) -> bytes:
    """A hash of a file's length and of three parts of it."""
    digest = hashlib.sha256()
    try:
        with open(path, "rb") as file:
            size = file.seek(0, os.SEEK_END)
            digest.update(size.to_bytes(8, "little"))
            for start in (0, size // 2, max(0, size - _SAMPLE)):
                file.seek(start)
                digest.update(file.read(_SAMPLE))
    except OSError as error:
        raise InputError(f"image {path}: cannot be read ({error.strerror}); copy it there again") from error
    return digest.digest()
