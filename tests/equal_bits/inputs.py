"""Small inputs, computed from nothing: photos of two painted balls, with masks, alpha or points; and two meshes."""

import json
import math
import shutil
from pathlib import Path

import numpy as np
from PIL import Image

VIEWS, WIDTH, HEIGHT, FOCAL = 14, 60, 48, 66.0
BALLS = ((np.array([0.0, -0.15, 0.0]), 0.8), (np.array([0.35, 0.75, 0.2]), 0.45))


def write_inputs(folder: Path) -> None:
    """Writes all of them into `folder`, unless they are there."""
    if folder.is_dir():
        return
    draft = folder.with_name(f"{folder.name}.draft")
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir(parents=True)
    poses = [_pose(view) for view in range(VIEWS)]
    photos = [_photo(pose) for pose in poses]
    for name in ("masked", "rgba", "pointless"):
        _write_scene(draft / name, poses, photos, alpha=name == "rgba", points=name != "pointless")
    (draft / "masked" / "masks").mkdir()
    for index, photo in enumerate(photos):
        Image.fromarray(photo[..., 3]).save(draft / "masked" / "masks" / f"{index:03d}.png")
    _write_mesh(draft / "blob.obj", lambda p: p * (1 + 0.2 * np.sin(3 * p[:, :1]) * np.cos(4 * p[:, 1:2])), 24, 48)
    _write_mesh(draft / "start.obj", lambda p: 1.2 * p * np.array([1.0, 1.1, 0.95]), 10, 20)
    draft.rename(folder)


def _pose(view: int) -> np.ndarray:
    """(4, 4) camera to world with OpenGL axes, on a rising spiral around the origin."""
    angle, height = 2.4 * view, -0.9 + 2.4 * view / VIEWS
    eye = np.array([3.2 * math.cos(angle), height, 3.2 * math.sin(angle)])
    back = eye / np.linalg.norm(eye)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, eye], axis=1)
    return pose


def _photo(pose: np.ndarray) -> np.ndarray:
    """(HEIGHT, WIDTH, 4) bytes; alpha is 1 on the balls, and 0 off them, where there is a sky all the same."""
    j, i = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(j - WIDTH / 2) / FOCAL, (HEIGHT / 2 - i) / FOCAL, -np.ones_like(i)], axis=-1) @ pose[:3, :3].T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    color = 0.55 + 0.3 * rays[..., 1:2] * np.array([0.4, 0.7, 1.0]) + 0.1 * np.sin(5 * rays)
    nearest = np.full((HEIGHT, WIDTH), np.inf)
    for center, radius in BALLS:
        offset = pose[:3, 3] - center
        middle = -rays @ offset
        under_root = middle**2 - offset @ offset + radius**2
        depth = np.where(under_root > 0, middle - np.sqrt(np.maximum(under_root, 0)), np.inf)
        hit = depth < nearest
        points = pose[:3, 3] + np.where(hit, depth, 0)[..., None] * rays
        color = np.where(hit[..., None], _paint(points, (points - center) / radius), color)
        nearest = np.where(hit, depth, nearest)
    pixels = np.concatenate([color.clip(0, 1), np.isfinite(nearest)[..., None]], axis=-1)
    return np.rint(255 * pixels).astype(np.uint8)


def _paint(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Colours of points on the balls: stripes in three directions under one light."""
    light = 0.55 + 0.45 * (normals @ np.array([0.36, 0.8, 0.48]))[..., None]
    return light * (0.5 + 0.45 * np.sin(np.array([7.0, 5.0, 9.0]) * points))


def _write_scene(folder: Path, poses: list[np.ndarray], photos: list[np.ndarray], *, alpha: bool, points: bool) -> None:
    (folder / "images").mkdir(parents=True)
    frames = []
    for index, (pose, photo) in enumerate(zip(poses, photos, strict=True)):
        file = f"images/{index:03d}.png"
        Image.fromarray(photo if alpha else photo[..., :3]).save(folder / file)
        frames.append({"file_path": file, "transform_matrix": pose.tolist()})
    document = {"fl_x": FOCAL, "w": WIDTH, "h": HEIGHT, "frames": frames}
    if points:
        _write_points(folder / "points.ply")
        document["ply_file_path"] = "points.ply"
    (folder / "transforms.json").write_text(json.dumps(document))


def _write_points(path: Path) -> None:
    rng = np.random.default_rng(0)
    rows = []
    for center, radius in BALLS:
        normals = rng.normal(size=(300, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        positions = center + radius * normals
        colors = np.rint(255 * _paint(positions, normals).clip(0, 1)).astype(int)
        rows += [" ".join(map(repr, [*p.tolist(), *c.tolist()])) for p, c in zip(positions, colors, strict=True)]
    kinds = [*(f"property float {axis}" for axis in "xyz"), *(f"property uchar {c}" for c in ("red", "green", "blue"))]
    head = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *kinds, "end_header"]
    path.write_text("\n".join([*head, *rows]) + "\n")


def _write_mesh(path: Path, shape, rings: int, columns: int) -> None:
    """A closed sphere of rings between two poles, moved by `shape` and painted."""
    polar = np.repeat(np.arange(1, rings) * math.pi / rings, columns)
    around = np.tile(np.arange(columns) * 2 * math.pi / columns, rings - 1)
    ring_points = np.stack([np.sin(polar) * np.cos(around), np.cos(polar), np.sin(polar) * np.sin(around)], axis=1)
    unit = np.concatenate([[[0.0, 1.0, 0.0]], ring_points, [[0.0, -1.0, 0.0]]])
    faces, last = [], len(unit)
    for k in range(columns):
        a, b = k, (k + 1) % columns
        faces.append((1, 2 + b, 2 + a))
        faces.append((last, last - columns + a, last - columns + b))
        for ring in range(rings - 2):
            upper, lower = 2 + ring * columns, 2 + (ring + 1) * columns
            faces += [(upper + a, upper + b, lower + a), (upper + b, lower + b, lower + a)]
    rows = np.concatenate([shape(unit), _paint(shape(unit), unit).clip(0, 1)], axis=1)
    lines = [f"v {' '.join(map(repr, row))}" for row in rows.tolist()]
    path.write_text("\n".join([*lines, *(f"f {a} {b} {c}" for a, b, c in faces)]) + "\n")
