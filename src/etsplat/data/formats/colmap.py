"""Scenes in COLMAP's layout: `images/` and `sparse/0/{cameras,images,points3D}.{bin,txt}`, undistorted.

COLMAP's poses are world-to-camera with OpenCV axes, its pixel centres at +0.5: our conventions, nothing to convert.
"""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.data.colmap_model import PARAMETERS, ColmapCamera, ColmapImage, read_cameras, read_images, read_points
from etsplat.data.dataset import Dataset
from etsplat.data.frames import Frame, Wanted, find_image, find_mask, posed

MARK = "sparse/"
RANK = 2


def recognises(folder: Path) -> bool:
    """Whether there is a model."""
    return (folder / "sparse").is_dir()


def read(folder: Path, wanted: Wanted) -> Dataset:
    """Read an undistorted COLMAP scene; every 8th image by name is test.

    Args:
        folder: holds `images/` and `sparse/0/` (or `sparse/`), binary or text; binary is preferred. Its `masks/`, if it
            is there, has a mask for every image; images with an alpha channel need none.
        wanted: other images and masks. `images_4` and the like may hold smaller copies, also with other endings.

    Returns:
        Views in COLMAP's own units, with the model's points.

    Raises:
        InputError: files are missing, cut short or malformed; camera models with distortion; a mask is missing; as
            `posed`.
    """
    model = find_model(folder)
    if model is None:
        raise InputError(
            f"scene {folder}: no sparse/0/cameras.bin or .txt; run COLMAP's mapper or choose another folder"
        )
    masks = wanted.masks or (folder / "masks" if (folder / "masks").is_dir() else None)
    cameras = read_cameras(model)
    registered = sorted(read_images(model), key=lambda image: image.name)
    if not registered:
        raise InputError(f"scene {folder}: the sparse model has no registered image; run COLMAP's mapper again")
    frames = []
    for image in registered:
        if image.camera not in cameras:
            raise InputError(f"scene {model}: {image.name} uses camera {image.camera}, which is missing; export again")
        camera = cameras[image.camera]
        K = _intrinsics(model, image.name, camera)
        mask = None if masks is None else find_mask(masks, image.name, model)
        file = find_image(folder / (wanted.images or "images"), image.name, model)
        frames.append(Frame(image.name, file, mask, _viewmat(image), K, (camera.width, camera.height)))
    found = read_points(model)
    if found is None or not len(found[0]):
        return posed(folder, frames, wanted)
    points, colors = torch.from_numpy(found[0]), torch.from_numpy(found[1].astype(np.float32) / 255)
    return posed(folder, frames, wanted, points=(points, colors))


def find_model(folder: Path) -> Path | None:
    """The sparse model of a scene folder: `sparse/0` or `sparse`, or None."""
    return next((path for path in (folder / "sparse" / "0", folder / "sparse") if _has_model(path)), None)


def _has_model(path: Path) -> bool:
    return any((path / f"cameras.{suffix}").is_file() for suffix in ("bin", "txt"))


def _intrinsics(model: Path, name: str, camera: ColmapCamera) -> Float[Tensor, "3 3"]:
    if camera.model not in ("PINHOLE", "SIMPLE_PINHOLE"):
        raise InputError(
            f"scene {model}: {name} has a {camera.model} camera with lens distortion;"
            " run `etsplat data undistort SCENE --out NEW` or `colmap image_undistorter`, and use the new folder"
        )
    if len(camera.params) != PARAMETERS[camera.model] or camera.width < 1 or camera.height < 1:
        raise InputError(f"scene {model}: the camera of {name} is malformed; export the model again")
    fx, fy, cx, cy = camera.params if camera.model == "PINHOLE" else (camera.params[0], *camera.params)
    if not np.isfinite(camera.params).all() or min(fx, fy) <= 0:
        raise InputError(f"scene {model}: the camera of {name} has no positive focal length; export the model again")
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)


def _viewmat(image: ColmapImage) -> Float[Tensor, "4 4"]:
    q = np.array(image.quaternion)
    norm = np.linalg.norm(q)
    if not np.isfinite([*q, *image.translation]).all() or norm < 1e-9:
        raise InputError(f"scene: the pose of {image.name} is not finite; run COLMAP's mapper again")
    w, x, y, z = q / norm
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.tensor(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    viewmat[:3, 3] = torch.tensor(image.translation)
    return viewmat
