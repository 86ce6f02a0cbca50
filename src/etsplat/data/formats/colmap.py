"""Scenes in COLMAP's layout: `images/` and `sparse/0/{cameras,images,points3D}.{bin,txt}`, undistorted.

COLMAP's poses are world-to-camera with OpenCV axes, its pixel centres at +0.5: our conventions, nothing to convert.
"""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.data.colmap_model import (
    PARAMETERS,
    ColmapCamera,
    ColmapImage,
    count_images,
    read_cameras,
    read_images,
    read_points,
)
from etsplat.data.frames import Frame, Lens, Listing, Wanted, pinhole
from etsplat.data.scene_files import placed_image, quaternion_rotation, unplaced_beside

MARK = "sparse/"
RANK = 2

_TESTED = "test.txt"
"""Beside a model: the names of its images for testing, a line each, as 3DGS has it."""


def recognises(folder: Path) -> bool:
    """Whether there is a model."""
    return (folder / "sparse").is_dir()


def list_frames(folder: Path, wanted: Wanted) -> Listing:
    """The registered images of a COLMAP scene, and the model's points.

    Images for testing are those that `test.txt` beside the model names, or else every 8th by name.

    Args:
        folder: holds the images, most often in `images/`, and `sparse/0/` (or `sparse/`), binary or text; binary is
            preferred. Its `masks/`, if it is there, has a mask for every image; images with an alpha channel need none.
            Its `depths/` or `depth/` may have depth maps.
        wanted: other images and masks. `images_4` and the like may hold smaller copies, also with other endings.

    Raises:
        InputError: files are missing, cut short or malformed; a mask is missing.
    """
    model = find_model(folder)
    if model is None:
        raise InputError(
            f"scene {folder}: no sparse/0/cameras.bin or .txt; run COLMAP's mapper or choose another folder"
        )
    cameras = read_cameras(model)
    registered = sorted(read_images(model), key=lambda image: image.name)
    if not registered:
        raise InputError(f"scene {folder}: the sparse model has no registered image; run COLMAP's mapper again")
    frames = [_frame(folder, model, image, cameras.get(image.camera), wanted) for image in registered]
    notes = unplaced_beside(frames)
    if (count := len(_models(folder))) > 1:
        notes += (f"{count} models in sparse/: {model.name}, which has the most images, is read, and no other",)
    split, found = _split(model, [image.name for image in registered]), read_points(model)
    if found is None or not len(found[0]):
        return Listing(frames, split, notes=notes)
    points, colors = torch.from_numpy(found[0]), torch.from_numpy(found[1].astype(np.float32) / 255)
    return Listing(frames, split, (points, colors), notes)


def write_tested(model: Path, names: list[str]) -> None:
    """Writes down which images of a model are for testing."""
    (model / _TESTED).write_text("".join(f"{name}\n" for name in names), encoding="utf-8")


def _split(model: Path, names: list[str]) -> tuple[list[int], list[int]] | None:
    """By `test.txt`, if it is there."""
    path = model / _TESTED
    if not path.is_file():
        return None
    said = {line.strip() for line in path.read_text(encoding="utf-8", errors="replace").splitlines()} - {""}
    test = [view for view, name in enumerate(names) if name in said]
    if said and len(test) in (0, len(names)):
        wrong = "names all images, none is left for training" if test else "names none of the images"
        raise InputError(f"scene {path}: {wrong}; correct or remove it")
    return [view for view, name in enumerate(names) if name not in said], test


def _frame(folder: Path, model: Path, image: ColmapImage, camera: ColmapCamera | None, wanted: Wanted) -> Frame:
    if camera is None:
        raise InputError(f"scene {model}: {image.name} uses camera {image.camera}, which is missing; export again")
    if len(camera.params) != PARAMETERS[camera.model]:
        raise InputError(f"scene {model}: the camera of {image.name} is malformed; export the model again")
    if camera.model == "EQUIRECTANGULAR":
        raise InputError(
            f"scene {model}: {image.name} has an EQUIRECTANGULAR camera, which is not read; make perspective pictures"
            " and find their cameras"
        )
    one_focal_length = "SIMPLE" in camera.model or "RADIAL" in camera.model
    fx, fy, cx, cy, *distortion = (camera.params[0], *camera.params) if one_focal_length else camera.params
    lens = Lens(camera.model, tuple(distortion), f"a {camera.model} camera with lens distortion")
    name, photo = placed_image(folder, image.name, model, wanted, any_end=False)
    return Frame(
        name,
        photo,
        wanted.mask_of(folder, name, model),
        _viewmat(image),
        pinhole(fx, fy, cx, cy),
        (camera.width, camera.height),
        lens if any(distortion) or "FISHEYE" in camera.model else None,
        wanted.depth_of(folder, name, model),
        wanted.depth_unit,
    )


def find_model(folder: Path) -> Path | None:
    """The sparse model of a scene folder: `sparse/0`, or the like that has the most images; or `sparse`."""
    models = _models(folder)
    return max(models, key=count_images) if len(models) > 1 else next(iter(models), None)


def _models(folder: Path) -> list[Path]:
    """The mapper makes several where photos do not hang together, and numbers them."""
    numbered = sorted(
        (path for path in (folder / "sparse").glob("*") if path.name.isdecimal()), key=lambda path: int(path.name)
    )
    found = [path for path in (*numbered, folder / "sparse") if _has_cameras(path)]
    return [path for path in found if path != folder / "sparse"] or found


def _has_cameras(folder: Path) -> bool:
    return any((folder / f"cameras.{suffix}").is_file() for suffix in ("bin", "txt"))


def _viewmat(image: ColmapImage) -> Float[Tensor, "4 4"]:
    q = np.array(image.quaternion)
    with np.errstate(over="ignore"):
        norm = float(np.linalg.norm(q))
    if not np.isfinite([norm, *image.translation]).all() or norm < 1e-9:
        raise InputError(f"scene: the pose of {image.name} is not finite; run COLMAP's mapper again")
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = quaternion_rotation(*(q / norm))
    viewmat[:3, 3] = torch.tensor(image.translation, dtype=torch.float64)
    return viewmat
