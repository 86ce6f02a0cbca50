"""Masks for photos of an object: made of a plain background, or brought along."""

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from jaxtyping import Bool
from PIL import Image

from etsplat.core.errors import InputError
from etsplat.data.frames import Wanted
from etsplat.data.load import format_of
from etsplat.data.photo_intake import brings_masks
from etsplat.data.plain_backgrounds import WORK_SIZE, find_object
from etsplat.data.scene_files import name_below
from etsplat.io.images import encode_png, image_size, is_transparent, load_mask, load_pixels, save_image
from etsplat.io.paths import kind_of

LEAST_SHARE = 0.5
"""Of the photos must have a plain background: else the few that seem to have one seem so by chance."""


def mask_file(folder: Path, name: str) -> Path:
    """Where the mask of a photo lies, as COLMAP names it."""
    return folder / f"{name}.png"


def posed_photos(scene: Path) -> dict[str, Path]:
    """The posed photos of a scene folder of any layout, by the names that their masks have, in the order of its views.

    Raises:
        InputError: the scene cannot be read.
    """
    images = [frame.image for frame in format_of(scene).list_frames(scene, Wanted()).frames]
    alone = len({image.stem for image in images}) == len(images)
    paths = [PurePosixPath(image.name if alone else name_below(image, scene)) for image in images]
    return {str(path.with_suffix("")): image for path, image in zip(paths, images, strict=True)}


def write_own_masks(
    photos: Mapping[str, Path], sizes: Mapping[str, tuple[int, int]], source: Path, folder: Path
) -> bool:
    """Writes the masks that photos bring along: pictures in `masks/` among them, or where they are transparent.

    Args:
        photos: the files by name.
        sizes: (width, height) of each, upright.
        source: folder of the photos.
        folder: for the masks, see `mask_file`.

    Returns:
        Whether there are any.

    Raises:
        InputError: `masks/` lacks one; one is damaged, or of another shape than its photo.
    """
    if brings_masks(source, photos.values()):
        found = {name: Wanted().mask_of(source, name, path) for name, path in photos.items()}
    else:
        with ThreadPoolExecutor() as pool:
            transparent = pool.map(lambda path: kind_of(path) == ".png" and is_transparent(path), photos.values())
            found = {
                name: path if clear else None for (name, path), clear in zip(photos.items(), transparent, strict=True)
            }
    if not any(found.values()):
        return False
    for name, path in found.items():
        target, (width, height) = mask_file(folder, name), sizes[name]
        target.parent.mkdir(parents=True, exist_ok=True)
        mask = torch.ones(height, width) if path is None else load_mask(path, (width, height))
        save_image(target, mask[..., None])
    return True


def write_masks(photos: Mapping[str, Path], folder: Path, report: Callable[[str, int, int], None]) -> dict[str, str]:
    """Writes a mask for each photo whose background is plain.

    Args:
        photos: upright photos by name.
        folder: for the masks, see `mask_file`.
        report: called with (phase, done, of how many).

    Returns:
        Why there is none, for the photos without.

    Raises:
        InputError: there is none for more than half of the photos; or one is damaged.
    """
    refused: dict[str, str] = {}
    for done, (name, photo) in enumerate(photos.items()):
        report("Masking", done, len(photos))
        size = image_size(photo)
        scale = min(1.0, WORK_SIZE / max(size))
        small = max(1, round(size[0] * scale)), max(1, round(size[1] * scale))
        found = find_object(load_pixels(photo, *small)[..., :3].numpy())
        if found.mask is None:
            refused[name] = found.problem
            continue
        write_mask(mask_file(folder, name), found.mask, size)
    report("Masking", len(photos), len(photos))
    if len(refused) > (1 - LEAST_SHARE) * len(photos):
        name, problem = next(iter(refused.items()))
        raise InputError(
            f"masks: can be found before a plain background alone, which {len(refused)} of {len(photos)} photos lack"
            f" ({name}: {problem}); leave the masks out, or photograph before a plain wall or sheet. Of photos with"
            " known cameras `etsplat data masks` also finds what stands on a surface"
        )
    return refused


def write_mask(path: Path, mask: Bool[np.ndarray, "H W"], size: tuple[int, int]) -> None:
    """Writes a mask in the (width, height) of its photo, which may be larger or smaller."""
    large = Image.fromarray(mask.astype(np.uint8) * 255).resize(size, Image.Resampling.BILINEAR)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encode_png(np.asarray(large)))
