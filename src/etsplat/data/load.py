"""One call for every kind of scene folder."""

import importlib
import pkgutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Protocol, cast

from etsplat.core.errors import InputError
from etsplat.core.precision import usual_defaults
from etsplat.core.spelling import option
from etsplat.data import formats
from etsplat.data.dataset import Dataset
from etsplat.data.doubtful_poses import with_doubts
from etsplat.data.frames import DEPTH_FOLDERS, LARGEST, MASK_FOLDER, Listing, MasksAs, Wanted, posed
from etsplat.data.georeferencing import near_origin
from etsplat.data.pictures import LazyPictures
from etsplat.io.paths import given_path, kind_of, path_remedy
from etsplat.io.photos import PHOTO_SUFFIXES, UNREAD_SUFFIXES, file_remedy
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

    def list_frames(self, folder: Path, wanted: Wanted) -> Listing:
        """What the files in a folder say of its posed photos; `etsplat.data.frames.posed` makes a data set of it.

        Raises:
            InputError: a file is missing, damaged, or says what is not understood.
        """
        ...


@usual_defaults()
def load_dataset(
    path: Path | str,
    *,
    masks_as: MasksAs = "ignore",
    images: str | None = None,
    width: int | None = None,
    masks: Path | str | None = None,
    memory: int | None = None,
    depths: bool | Path | str = False,
    depth_unit: float | None = None,
    preload: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> Dataset:
    """Read a folder with posed photos in its own units; images are decoded in parallel.

    Coordinates of maps are made relative to an origin nearby; `Dataset.georeference` says where that is.

    `docs/captures.md` lists the programs whose files are read: COLMAP, nerfstudio, Blender, Polycam, Record3D,
    RealityCapture, Metashape, Meshroom, OpenMVG, Bundler, OpenSfM, OpenDroneMap, and the layouts of NeuS, LLFF, NSVF,
    NeRF++ and MVSNet.

    Args:
        path: the folder.
        masks_as: "ignore": what masks exclude is ignored, and photos are bytes. "alpha": masks are transparency, which
            separates an object from its background, and photos are float32 premultiplied RGBA.
        images: folder in it to take the images from (`images_4`); None for what it names.
        width: shrink images to this many pixels across (never enlarges); None shrinks those wider than 1600 to 1600.
        masks: folder with a mask for every image, white inside; None for the scene's own, if any.
        memory: bytes that decoded images may take, beyond which they are streamed; None for half of what is free.
        depths: read depth maps too: the scene's own, if any, or those in a folder. Images without one are fine.
        depth_unit: units of the capture in a step of their numbers; None for what the scene says, or else 0.001 for
            integers and 1 for others.
        preload: decode the images now, so that damaged ones are found; else each when it is first asked for.
        progress: called with (images decoded, images in all) while loading.

    Raises:
        InputError: no such folder, none of the layouts, or what the layout's reader refuses; fewer than two images;
            damaged images, masks or depth maps; images of another shape than their camera, or maps than their image.
        ValueError: a width below 1, a unit that is not positive.

    Example:
        Two photos, with the file that nerfstudio has beside them:

        >>> import json
        >>> from pathlib import Path
        >>> frames = []
        >>> for index, x in enumerate((-1.0, 1.0)):
        ...     etsplat.save_image(f"{index}.png", torch.rand(12, 16, 3))
        ...     pose = [[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]
        ...     frames.append({"file_path": f"{index}.png", "transform_matrix": pose})
        >>> lens = {"w": 16, "h": 12, "fl_x": 20.0, "fl_y": 20.0, "cx": 8.0, "cy": 6.0}
        >>> Path("transforms.json").write_text(json.dumps({**lens, "frames": frames})) > 0
        True
        >>> etsplat.load_dataset(".").images[0].shape
        torch.Size([12, 16, 3])
    """
    if depth_unit is not None and not 0 < depth_unit <= LARGEST:
        raise ValueError(f"depth_unit: expected a positive number, got {depth_unit}")
    if width is not None and width < 1:
        raise ValueError(f"width: expected at least 1, got {width}")
    path = given_path("path", path, "the path of a folder")
    if not path.is_dir():
        wrong = "is a file; name the scene's folder" if path.is_file() else f"no such folder; {path_remedy(path)}"
        raise InputError(f"scene {path}: {file_remedy(path) or wrong}")
    if images is not None and not (path / images).is_dir():
        raise InputError(f"scene {path}: no folder {images} in it; choose another or leave it out")
    folder = depths if isinstance(depths, bool) else Path(depths)
    wanted = Wanted(masks_as, images, width, None if masks is None else Path(masks), memory, folder, depth_unit)
    listing = format_of(path).list_frames(path, wanted)
    if isinstance(folder, Path) and not any(frame.depth for frame in listing.frames):
        raise InputError(
            f"depths {folder}: has no map for any photo; call them like their photos: a.png, a.npy or a.exr"
        )
    dataset = posed(path, near_origin(path, listing), wanted)
    unread = (*_other_masks(path, wanted, listing), *_maps_of_some(path, wanted, dataset))
    dataset = with_doubts(replace(dataset, notes=(*dataset.notes, *unread)))
    if preload and isinstance(dataset.images, LazyPictures):
        dataset.images.preload(progress)
    return dataset


def _other_masks(path: Path, wanted: Wanted, listing: Listing) -> tuple[str, ...]:
    """A note on a folder that is called nearly as that of masks, where there is none and the layout has none there."""
    known = wanted.masks is not None or any(frame.mask for frame in listing.frames)
    if known or (path / MASK_FOLDER).is_dir() or not (path / "mask").is_dir():
        return ()
    named = f"call it {MASK_FOLDER}/, or name it with {option('masks', ...)}"
    return (f"mask/ is not read: {named}, if masks of all images are there",)


def _maps_of_some(path: Path, wanted: Wanted, dataset: Dataset) -> tuple[str, ...]:
    """How many photos have a depth map, where not all for training have one; or that a folder has none that is read."""
    known = sum(view in dataset.images.with_depth for view in dataset.train)
    own = next((name for name in DEPTH_FOLDERS if (path / name).is_dir()), None)
    if not dataset.images.with_depth and wanted.depths is True and own is not None:
        return (f"{own}/ has no map for any photo: call them like their photos, a.png (16 bits), a.npy or a.exr",)
    if not dataset.images.with_depth or known == len(dataset.train):
        return ()
    return (f"{known} of {len(dataset.train)} photos for training have a depth map",)


def format_of(path: Path) -> Format:
    """The layout of a folder.

    Raises:
        InputError: none is recognised.
    """
    names = [f"{formats.__name__}.{module.name}" for module in pkgutil.iter_modules(formats.__path__)]
    known = sorted((cast(Format, importlib.import_module(name)) for name in names), key=lambda known: known.RANK)
    for layout in known:
        if layout.recognises(path):
            return layout
    marks = ", ".join(layout.MARK for layout in known)
    raise InputError(f"scene {path}: none of {marks} in it; choose the scene's folder{_offer(path, known)}")


def _offer(path: Path, known: Sequence[Format]) -> str:
    """For a run: that it is one. For a part of a scene, or what it lies in: that scene. For photos: how to go on."""
    if is_run(path):
        return " that this run was made from"
    around = path.absolute().parents[:2]
    with suppress(OSError):  # folders that may not be read
        places = [*around, *sorted(place for place in path.iterdir() if place.is_dir())]
        meant = next((place for place in places if any(layout.recognises(place) for layout in known)), None)
        if meant is not None:
            return f": did you mean {meant}?"
    if any(kind_of(file) in (*PHOTO_SUFFIXES, *UNREAD_SUFFIXES) for file in path.iterdir()):
        return f", or find the cameras of these photos: etsplat data sfm {path} --out SCENE"
    return ""
