"""What all capture formats share: frames (file, pose, intrinsics, mask) with split and points; views made of them."""

import os
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.core.errors import InputError
from etsplat.data.views import Normalization, PosedViews
from etsplat.io.images import IMAGE_SUFFIXES, image_size, load_image, load_mask, premultiply, resize_image
from etsplat.io.paths import path_remedy


@dataclass(frozen=True)
class Frame:
    """One posed image of a capture.

    Attributes:
        name: path of the image as the capture names it, with forward slashes.
        image: the file.
        mask: its mask (white inside the object), or None.
        viewmat: (4, 4) float64, world to camera, OpenCV axes.
        K: (3, 3) float64, pixels of an image of `size`.
        size: (width, height) that K refers to; the file may be a smaller or larger copy.
    """

    name: str
    image: Path
    mask: Path | None
    viewmat: Float[Tensor, "4 4"]
    K: Float[Tensor, "3 3"]
    size: tuple[int, int]


@dataclass(frozen=True)
class FrameSet:
    """What a reader finds in a capture; no image has been decoded yet.

    Attributes:
        source: the capture's folder, for error messages.
        frames: at least one; their names are unique.
        train: indices of the frames to optimise on, ascending.
        test: indices of the frames held out, ascending.
        points: (P, 3) float64, P > 0, in the units of the poses; or None.
        point_colors: (P, 3) float32 in [0, 1] as displayed; or None without points.
    """

    source: Path
    frames: list[Frame]
    train: list[int]
    test: list[int]
    points: Float[Tensor, "P 3"] | None = None
    point_colors: Float[Tensor, "P 3"] | None = None

    def __post_init__(self) -> None:
        name, count = Counter(frame.name for frame in self.frames).most_common(1)[0]
        if count > 1:
            raise InputError(f"scene {self.source}: {count} frames have the image {name}; keep one of them")
        missing = [frame for frame in self.frames if not frame.image.is_file()]
        if missing:
            raise InputError(
                f"scene {self.source}: {len(missing)} of {len(self.frames)} images are missing"
                f" (first: {missing[0].image}); copy them there or remove their poses"
            )

    @property
    def view_names(self) -> list[str]:
        """Names fit for files: folders joined by underscores, endings dropped unless that made two alike."""
        full = [frame.name.removeprefix("./").replace("/", "_") for frame in self.frames]
        short = [PurePosixPath(name).stem for name in full]
        return short if len(set(short)) == len(short) else full


def posed_views(frame_set: FrameSet, *, width: int | None = None) -> PosedViews:
    """Decode the images of all frames, in parallel, and set up their cameras in the capture's own units.

    Args:
        frame_set: at least two frames.
        width: shrink the images to this many pixels across (never enlarges).

    Raises:
        InputError: fewer than two frames, damaged images, images of different sizes, or of another shape than the
            intrinsics say; masks of another size than their images.
    """
    source, frames = frame_set.source, frame_set.frames
    check_count(source, frames)
    if width is not None and width < 1:
        raise ValueError(f"width: expected at least 1, got {width}")
    size = _common_size(source, frames)
    target = size if width is None or width >= size[0] else (width, max(1, round(size[1] * width / size[0])))
    images = torch.empty(len(frames), target[1], target[0], 4)

    def decode(index: int) -> None:
        image = _masked_image(frames[index])
        images[index] = image if target == size else resize_image(image, *target)

    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        list(pool.map(decode, range(len(frames))))  # list() re-raises the first error
    Ks = torch.stack([scaled_intrinsics(source, frame, size, target) for frame in frames])
    viewmats = torch.stack([frame.viewmat for frame in frames])
    cameras = Cameras(viewmats.float(), Ks.float(), *target)
    return PosedViews(cameras, images, frame_set.view_names, frame_set.train, frame_set.test, Normalization.identity())


def check_count(source: Path, frames: Sequence[Frame]) -> None:
    """Raises InputError for fewer than two frames: one to learn from, one to test."""
    if len(frames) < 2:
        raise InputError(f"scene {source}: has {len(frames)} posed images; at least 2 are needed, better 20")


def find_image(folder: Path, name: str) -> Path:
    """The file of image `name` in a folder, or one that differs in its ending; as named if there is none."""
    path = folder / name
    return _with_any_ending(path) or path


def find_mask(folder: Path, name: str) -> Path:
    """The mask of image `name` in a folder: NAME itself, with another ending, or with .png added as COLMAP has it.

    Raises:
        InputError: there is none, or no folder.
    """
    if not folder.is_dir():
        raise InputError(f"masks {folder}: no such folder; {path_remedy(folder)}")
    path = folder / name
    found = _with_any_ending(path)
    if found is None:
        raise InputError(f"masks {folder}: no mask for image {name}; add {path.with_suffix('.png').name}")
    return found


def _with_any_ending(path: Path) -> Path | None:
    """The file at a path, or one with an image's ending, small or large, in place of its own or added to it."""
    endings = [ending for suffix in IMAGE_SUFFIXES for ending in (suffix, suffix.upper())]
    candidates = [path, *(path.with_suffix(ending) for ending in endings), *(Path(f"{path}{s}") for s in endings)]
    return next((candidate for candidate in candidates if candidate.is_file()), None)


def _common_size(source: Path, frames: Sequence[Frame]) -> tuple[int, int]:
    first = image_size(frames[0].image)
    for frame in frames:
        size = image_size(frame.image)
        if size != first:
            raise InputError(
                f"scene {source}: images of different sizes ({frames[0].name} is {first[0]}x{first[1]}, {frame.name} is"
                f" {size[0]}x{size[1]}); resize them to one size"
            )
    return first


def _masked_image(frame: Frame) -> Float[Tensor, "H W 4"]:
    image = premultiply(load_image(frame.image))
    if frame.mask is None:
        return image
    mask = load_mask(frame.mask)
    if mask.shape != image.shape[:2]:
        raise InputError(
            f"mask {frame.mask}: is {mask.shape[1]}x{mask.shape[0]}, its image is {image.shape[1]}x{image.shape[0]};"
            " resize the mask"
        )
    return image * mask[..., None]


def scaled_intrinsics(
    source: Path, frame: Frame, size: tuple[int, int], target: tuple[int, int]
) -> Float[Tensor, "3 3"]:
    """K for images of `target` pixels, when the file has `size` and K refers to `frame.size`; float64.

    Raises:
        InputError: the file has another shape than K's image.
    """
    scale = size[0] / frame.size[0]
    if abs(frame.size[1] * scale - size[1]) > 2:  # downscaled copies are rounded to whole pixels
        raise InputError(
            f"scene {source}: {frame.name} is {size[0]}x{size[1]}, but its camera is for"
            f" {frame.size[0]}x{frame.size[1]}; use the images that the poses were made from"
        )
    ratio = torch.tensor([target[0] / frame.size[0], target[1] / frame.size[1], 1.0], dtype=torch.float64)
    return frame.K * ratio[:, None]
