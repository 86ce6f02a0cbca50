"""Scenes in COLMAP's layout: `images/` and `sparse/0/{cameras,images,points3D}.{bin,txt}`, undistorted.

COLMAP's poses are world-to-camera with OpenCV axes, its pixel centres at +0.5: our conventions, nothing to convert.
"""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.errors import InputError
from etsplat.data.colmap_model import PARAMETERS, ColmapImage, read_cameras, read_images, read_points
from etsplat.data.frames import Frame, Lens, Listing, Wanted, pinhole
from etsplat.data.scene_files import placed_image, quaternion_rotation

MARK = "sparse/"
RANK = 2


def recognises(folder: Path) -> bool:
    """Whether there is a model."""
    return (folder / "sparse").is_dir()


def list_frames(folder: Path, wanted: Wanted) -> Listing:
    """The registered images of a COLMAP scene, and the model's points; every 8th image by name is test.

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
    frames = []
    for image in registered:
        camera = cameras.get(image.camera)
        if camera is None:
            raise InputError(f"scene {model}: {image.name} uses camera {image.camera}, which is missing; export again")
        if len(camera.params) != PARAMETERS.get(camera.model):
            raise InputError(f"scene {model}: the camera of {image.name} is malformed; export the model again")
        one_focal_length = "SIMPLE" in camera.model or "RADIAL" in camera.model
        fx, fy, cx, cy, *distortion = (camera.params[0], *camera.params) if one_focal_length else camera.params
        lens = Lens(camera.model, tuple(distortion), f"a {camera.model} camera with lens distortion")
        name, photo = placed_image(folder, image.name, model, wanted)
        frames.append(
            Frame(
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
        )
    found = read_points(model)
    if found is None or not len(found[0]):
        return Listing(frames)
    points, colors = torch.from_numpy(found[0]), torch.from_numpy(found[1].astype(np.float32) / 255)
    return Listing(frames, points=(points, colors))


def find_model(folder: Path) -> Path | None:
    """The sparse model of a scene folder: `sparse/0` or `sparse`, or None."""
    folders = [folder / "sparse" / "0", folder / "sparse"]
    return next((path for path in folders if any((path / f"cameras.{s}").is_file() for s in ("bin", "txt"))), None)


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
