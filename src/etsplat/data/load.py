"""One call for every kind of scene folder."""

from pathlib import Path

from etsplat.core.errors import InputError
from etsplat.data.colmap import read_colmap
from etsplat.data.frames import FrameSet, posed_views
from etsplat.data.hull import bounding_sphere
from etsplat.data.transforms import read_transforms
from etsplat.data.views import PosedViews
from etsplat.io.images import IMAGE_SUFFIXES
from etsplat.io.paths import kind_of, path_remedy
from etsplat.io.run_directory import is_run


def read_scene(path: Path | str, masks: Path | str | None = None, *, images: str | None = None) -> FrameSet:
    """Read what a capture says about its images, without decoding them.

    Args:
        path: folder with `transforms.json` or `transforms_train.json` (`etsplat.data.transforms`), or with `images/`
            and `sparse/` (`etsplat.data.colmap`).
        masks: folder with a mask for every image, instead of the scene's own.
        images: folder in the scene to take the images from (`images_4`).

    Raises:
        InputError: no such folder, neither layout, or what the layouts' readers refuse.
    """
    path = Path(path)
    if not path.is_dir():
        wrong = "is a file; name the scene's folder" if path.is_file() else f"no such folder; {path_remedy(path)}"
        raise InputError(f"scene {path}: {wrong}")
    if images is not None and not (path / images).is_dir():
        raise InputError(f"scene {path}: no folder {images} in it; choose another or leave it out")
    if any((path / name).is_file() for name in ("transforms.json", "transforms_train.json")):
        return read_transforms(path, masks, images=images)
    if (path / "sparse").is_dir():
        return read_colmap(path, masks, images=images)
    raise InputError(
        f"scene {path}: neither transforms.json nor sparse/ in it; choose the scene's folder{_offer(path)}"
    )


def load_views(path: Path | str, width: int | None = None, masks: Path | str | None = None) -> PosedViews:
    """Read a capture of an object and move it into the unit frame: the object lies inside the unit sphere.

    Args:
        path: as `read_scene`. Needs RGBA images or masks.
        width: shrink the images to this many pixels across (never enlarges).
        masks: folder with a mask for every image, instead of the scene's own.

    Raises:
        InputError: as `read_scene`, `etsplat.data.frames.posed_views` and `etsplat.data.hull.bounding_sphere`.
    """
    views = posed_views(read_scene(path, masks), width=width)
    return views.renormalized(*bounding_sphere(views))


def _offer(path: Path) -> str:
    """For a run: that it is one. For a folder of photos: how to find the cameras."""
    if is_run(path):
        return " that this run was made from"
    if any(kind_of(file) in IMAGE_SUFFIXES for file in path.iterdir()):
        return f", or find the cameras of these photos: etsplat data sfm {path} --out SCENE"
    return ""
