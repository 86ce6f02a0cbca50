"""Small captures, most of them on disk: COLMAP, transforms.json, noise for photos, cameras on a circle."""

import json
import math
from dataclasses import replace

import numpy as np
import torch
from PIL import Image

from etsplat import look_at
from etsplat.data.dataset import Dataset
from etsplat.data.demo_scene import demo_scene
from etsplat.data.photograph import FIELD_OF_VIEW
from etsplat.io.images import save_image

UP = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)


def circle_poses(count, center=(0.0, 0.0, 0.0), radius=3.0):
    """(count, 4, 4) float64 viewmats that look at `center`."""
    angles = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
    center = torch.tensor(center, dtype=torch.float64)
    offsets = torch.stack([angles.cos(), torch.full_like(angles, 0.3), angles.sin()], dim=1) * radius
    return look_at(center + offsets, center, UP)


def quaternion(rotation):
    """Unit quaternion (w, x, y, z) of a rotation matrix: the null vector of a symmetric 4x4 problem (Bar-Itzhack)."""
    r = rotation.double()
    k = torch.tensor(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], 0, 0, 0],
            [r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], 0, 0],
            [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1], 0],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], r[0, 0] + r[1, 1] + r[2, 2]],
        ]
    )
    x, y, z, w = torch.linalg.eigh(k, UPLO="L").eigenvectors[:, -1].tolist()
    return w, x, y, z


def write_photo(path, width, height, seed=0, channels=3):
    """Noise, smooth enough that JPEG keeps it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    small = rng.integers(0, 256, (4, 4, channels), dtype=np.uint8)
    Image.fromarray(small).resize((width, height), Image.Resampling.BILINEAR).save(path, quality=95)


def write_colmap(folder, sizes, *, poses=None, points=20, image_folder="images", model="PINHOLE", extra=()):
    """A text model with a camera for each image; photo k has the size sizes[k] and a focal length of its width."""
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    poses = circle_poses(len(sizes)) if poses is None else poses
    cameras, images = "", ""
    for index, ((width, height), pose) in enumerate(zip(sizes, poses, strict=True)):
        focal = width + 0.0
        params = [focal, focal, width / 2 + 1, height / 2] if model == "PINHOLE" else [focal, width / 2, height / 2]
        cameras += f"{index} {model} {width} {height} {' '.join(map(repr, [*params, *extra]))}\n"
        pose_text = " ".join(repr(v) for v in [*quaternion(pose[:3, :3]), *pose[:3, 3].tolist()])
        images += f"{index} {pose_text} {index} {index:04d}.jpg\n\n"
        write_photo(folder / image_folder / f"{index:04d}.jpg", width, height, seed=index)
    (sparse / "cameras.txt").write_text(cameras)
    (sparse / "images.txt").write_text(images)
    if points:
        rng = np.random.default_rng(1)
        rows = [
            f"{k} {' '.join(map(str, rng.normal(size=3)))} {' '.join(map(str, rng.integers(0, 256, 3)))} 0.5\n"
            for k in range(points)
        ]
        (sparse / "points3D.txt").write_text("".join(rows))


def write_transforms(folder, count, *, width=16, height=12, channels=3, **settings):
    """transforms.json with `count` PNG frames on a circle."""
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    frames = []
    for index, pose in enumerate(circle_poses(count)):
        write_photo(folder / "images" / f"{index:04d}.png", width, height, index, channels)
        frames.append({"file_path": f"images/{index:04d}.png", "transform_matrix": (pose.inverse() @ flip).tolist()})
    document = {"fl_x": width, "w": width, "h": height, "frames": frames, **settings}
    (folder / "transforms.json").write_text(json.dumps(document))


def opengl_pose(viewmat):
    """Camera to world with OpenGL's axes, as transforms.json has it."""
    return (torch.linalg.inv(viewmat.double()) @ torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]).double())).tolist()


def write_views(folder, views, indices, name, **settings):
    """Writes the views with the given indices as RGBA PNG beside a JSON file `name`; returns the document."""
    frames = []
    for index in indices:
        image = views.images[index].clone()
        image[..., :3] /= image[..., 3:].clamp_min(1e-6)
        (folder / "images").mkdir(parents=True, exist_ok=True)
        save_image(folder / "images" / f"{index:03d}.png", image)
        frames.append({"file_path": f"./images/{index:03d}", "transform_matrix": opengl_pose(views.viewmats[index])})
    document = {"camera_angle_x": math.radians(FIELD_OF_VIEW), "frames": frames, **settings}
    (folder / name).write_text(json.dumps(document))
    return document


def small_demo_scene() -> Dataset:
    """The demo's scene in pictures of 64 x 48, with 400 of its points: enough for short runs."""
    scene = demo_scene(64, 48)
    keep = torch.arange(0, 4000, 10)
    assert scene.exact_points is not None
    assert scene.point_colors is not None
    return replace(scene, exact_points=scene.exact_points[keep], point_colors=scene.point_colors[keep])
