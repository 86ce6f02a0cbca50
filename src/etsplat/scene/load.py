"""One call for every kind of scene folder."""

from pathlib import Path

from etsplat.core.errors import InputError
from etsplat.scene.colmap import load_colmap
from etsplat.scene.hull import bounding_sphere
from etsplat.scene.transforms import load_transforms
from etsplat.scene.views import PosedViews


def load_views(path: Path | str, width: int | None = None) -> PosedViews:
    """Read a capture of an object and move it into the unit frame: the object lies inside the unit sphere.

    Args:
        path: folder with `transforms.json` or `transforms_train.json` (`etsplat.scene.transforms`), or with `images/`
            and `sparse/` (`etsplat.scene.colmap`). Needs RGBA images or masks.
        width: shrink the images to this many pixels across (never enlarges).

    Raises:
        InputError: no such folder, neither layout, anything that the layouts' loaders or
            `etsplat.scene.hull.bounding_sphere` refuse.
    """
    path = Path(path)
    if not path.is_dir():
        raise InputError(f"scene {path}: no such folder; check the path")
    if any((path / name).is_file() for name in ("transforms.json", "transforms_train.json")):
        views = load_transforms(path, width=width)
    elif (path / "sparse").is_dir():
        views = load_colmap(path, width=width)
    else:
        raise InputError(f"scene {path}: neither transforms.json nor sparse/ in it; choose the scene's folder")
    return views.renormalized(*bounding_sphere(views))
