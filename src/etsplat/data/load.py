"""One call for every kind of scene folder."""

import importlib
import pkgutil
from collections.abc import Callable
from pathlib import Path
from typing import Protocol, cast

from etsplat.core.errors import InputError
from etsplat.data import formats
from etsplat.data.dataset import Dataset
from etsplat.data.frames import MasksAs, Wanted
from etsplat.data.pictures import LazyPictures
from etsplat.io.images import IMAGE_SUFFIXES
from etsplat.io.paths import kind_of, path_remedy
from etsplat.io.run_directory import is_run


class Format(Protocol):
    """A module of `etsplat.data.formats`: one layout of folders.

    Attributes:
        MARK: what such a folder has in it, for error messages.
        RANK: a folder may look like several layouts; the smallest comes first.
    """

    MARK: str
    RANK: int

    def recognises(self, folder: Path) -> bool:
        """Whether a folder is of this layout."""
        ...

    def read(self, folder: Path, wanted: Wanted) -> Dataset:
        """The posed photos in a folder; `etsplat.data.frames.posed` makes them of frames. None is decoded yet."""
        ...


def load_dataset(
    path: Path | str,
    *,
    masks_as: MasksAs = "ignore",
    images: str | None = None,
    width: int | None = None,
    masks: Path | str | None = None,
    memory: int | None = None,
    preload: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> Dataset:
    """Read a folder with posed photos (COLMAP, nerfstudio, Blender) in its own units; images are decoded in parallel.

    Args:
        path: the folder.
        masks_as: "ignore": what masks exclude is ignored, and photos are bytes. "alpha": masks are transparency, which
            separates an object from its background, and photos are float32 premultiplied RGBA.
        images: folder in it to take the images from (`images_4`); None for what it names.
        width: shrink images to this many pixels across (never enlarges); None shrinks those wider than 1600 to 1600.
        masks: folder with a mask for every image, white inside; None for the scene's own, if any.
        memory: bytes that decoded images may take, beyond which they are streamed; None for half of what is free.
        preload: decode the images now, so that damaged ones are found; else each when it is first asked for.
        progress: called with (images decoded, images in all) while loading.

    Raises:
        InputError: no such folder, none of the layouts, or what the layout's reader refuses; fewer than two images;
            damaged images or masks; images of another shape than their camera.
        ValueError: a width below 1.
    """
    if width is not None and width < 1:
        raise ValueError(f"width: expected at least 1, got {width}")
    path = Path(path)
    if not path.is_dir():
        wrong = "is a file; name the scene's folder" if path.is_file() else f"no such folder; {path_remedy(path)}"
        raise InputError(f"scene {path}: {wrong}")
    if images is not None and not (path / images).is_dir():
        raise InputError(f"scene {path}: no folder {images} in it; choose another or leave it out")
    wanted = Wanted(masks_as, images, width, None if masks is None else Path(masks), memory)
    dataset = _format_of(path).read(path, wanted)
    if preload and isinstance(dataset.images, LazyPictures):
        dataset.images.preload(progress)
    return dataset


def _format_of(path: Path) -> Format:
    names = [f"{formats.__name__}.{module.name}" for module in pkgutil.iter_modules(formats.__path__)]
    known = sorted((cast(Format, importlib.import_module(name)) for name in names), key=lambda known: known.RANK)
    for layout in known:
        if layout.recognises(path):
            return layout
    marks = " nor ".join(layout.MARK for layout in known)
    raise InputError(f"scene {path}: neither {marks} in it; choose the scene's folder{_offer(path)}")


def _offer(path: Path) -> str:
    """For a run: that it is one. For a folder of photos: how to find the cameras."""
    if is_run(path):
        return " that this run was made from"
    if any(kind_of(file) in IMAGE_SUFFIXES for file in path.iterdir()):
        return f", or find the cameras of these photos: etsplat data sfm {path} --out SCENE"
    return ""
