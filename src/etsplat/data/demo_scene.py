"""The demo's scene, built in code: painted things on a round table under a sky, with everything that photos bring.

Flat patterns, gradients, thin stripes, a shiny ball (its highlight moves with the camera), occlusion, and a far
background.
"""

import math
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from etsplat.core.cameras import Cameras, intrinsics, look_at, sphere_grid
from etsplat.core.precision import usual_defaults
from etsplat.data.dataset import Dataset, every_eighth
from etsplat.data.pictures import StoredPictures
from etsplat.engines.threads import one_torch_thread
from etsplat.geometry.icosphere import icosphere
from etsplat.ops.rasterize_opaque import render_opaque

WIDTH, HEIGHT = 400, 300
POINTS = 4000
_SUPERSAMPLING = 3
_LIGHT = np.array([0.45, 0.8, 0.4]) / np.linalg.norm([0.45, 0.8, 0.4])
_SKY_RADIUS = 14.0

Part = tuple[np.ndarray, np.ndarray]
"""Corner positions (F, 3, 3) and colours (F, 3)."""


@usual_defaults()
def demo_scene(
    width: int = WIDTH, height: int = HEIGHT, *, progress: Callable[[int, int], None] | None = None
) -> Dataset:
    """Photographs of the scene with their cameras and points: 42 views in two rings, every eighth of them for testing.

    Deterministic.

    Args:
        width: of the photos, in pixels.
        height: of the photos, in pixels.
        progress: called with (photos taken, photos in all).

    Example:
        >>> photos = etsplat.demo_scene(16, 12)
        >>> len(photos.train), len(photos.test)
        (36, 6)
    """
    vertices, base = demo_surface()
    rings = [
        sphere_grid([elevation], [360 / 21 * k + 8 * elevation for k in range(21)], 4.2) for elevation in (16.0, 38.0)
    ]
    eyes = torch.cat(rings) + torch.tensor([0.0, 0.35, 0.0])
    viewmats = look_at(eyes, torch.tensor([0.0, 0.35, 0.0]), torch.tensor([0.0, 1.0, 0.0]))
    K = intrinsics(42.0, width, height)
    photos = []
    with one_torch_thread():
        for index, viewmat in enumerate(viewmats):
            photos.append(demo_photo(vertices, base, Cameras(viewmat[None], K[None], width, height)))
            if progress is not None:
                progress(index + 1, len(viewmats))
    names = [f"view_{index:02d}" for index in range(len(viewmats))]
    train, test = every_eighth(len(names))
    chosen = torch.randperm(len(vertices), generator=torch.Generator().manual_seed(0))[:POINTS]
    return Dataset(
        viewmats=viewmats.double(),
        Ks=K.double().expand(len(viewmats), 3, 3),
        images=StoredPictures(photos),
        names=names,
        train=train,
        test=test,
        exact_points=vertices[chosen].mean(dim=1).double(),
        point_colors=base[chosen].clamp(0, 1),
    )


def demo_surface() -> tuple[Float[Tensor, "F 3 3"], Float[Tensor, "F 3"]]:
    """Corners and colours of all faces of the scene, its sky among them; blue above 1 marks a face as shiny."""
    corners, colors = (np.concatenate(parts) for parts in zip(*_parts(), strict=True))
    return torch.from_numpy(corners.astype(np.float32)), torch.from_numpy(colors.astype(np.float32))


def demo_photo(vertices: Float[Tensor, "F 3 3"], base: Float[Tensor, "F 3"], camera: Cameras) -> UInt8[Tensor, "H W 3"]:
    """A photograph of the surface that `demo_surface` gives, by a camera anywhere: (H, W, 3) bytes."""
    first, second = vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0]
    normals = torch.nn.functional.normalize(torch.linalg.cross(first, second), dim=1)
    towards = torch.nn.functional.normalize(camera.centers - vertices.mean(dim=1), dim=1)
    half = torch.nn.functional.normalize(towards + torch.from_numpy(_LIGHT).float(), dim=1)
    shiny = (base[:, 2:] > 1).float()
    glint = (normals * half).sum(dim=1, keepdim=True).clamp_min(0) ** 40
    colors = base.clamp(0, 1) + 0.7 * shiny * glint
    picture = render_opaque(vertices, face_colors=colors.clamp(0, 1), cameras=camera, supersampling=_SUPERSAMPLING)
    return (255 * picture.color[0] + 0.5).to(torch.uint8)


def _parts() -> list[Part]:
    sphere = _corners(*icosphere(5))
    ball = sphere * 0.42 + np.array([0.62, 0.42, 0.35])
    planet = sphere * 0.36 + np.array([-0.75, 0.36, 0.45])
    sky = sphere[:, ::-1] * _SKY_RADIUS
    return [
        _lit(_disc(1.7, 64, 360), _table),
        _lit(ball, lambda p: np.tile([0.75, 0.16, 1.12], (len(p), 1))),  # blue above 1: shiny
        _lit(planet, lambda p: _marble(p - planet.mean(axis=(0, 1)))),
        _lit(_box((-0.15, 0.45, -0.55), (0.3, 0.45, 0.3), 0.5, 44), _brick),
        _lit(_torus((0.05, 0.1, 0.95), 0.3, 0.1), _stripes),
        _lit(_cone((0.95, 0.0, -0.6), 0.3, 1.0), _spiral),
        (sky, _sky(sky.mean(axis=1))),
    ]


def _lit(corners: np.ndarray, paint: Callable[[np.ndarray], np.ndarray]) -> Part:
    """Faces with the colour that `paint` gives their centroids, under the light and a bright sky."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    shade = 0.55 + 0.45 * np.clip(normals @ _LIGHT, 0, 1)
    colors = paint(corners.mean(axis=1))
    return corners, np.where(colors > 1, colors, colors * shade[:, None])


def _table(p: np.ndarray) -> np.ndarray:
    checks = (np.floor(4 * p[:, 0]) + np.floor(4 * p[:, 2])) % 2
    rim = np.hypot(p[:, 0], p[:, 2]) > 1.55
    colors = np.where(checks[:, None] > 0, [0.86, 0.82, 0.7], [0.3, 0.42, 0.46])
    return np.where(rim[:, None], [0.5, 0.28, 0.12], colors)


def _marble(p: np.ndarray) -> np.ndarray:
    wave = np.sin(14 * p[:, 0] + 4 * np.sin(9 * p[:, 1]) + 3 * np.sin(11 * p[:, 2]))
    mix = (0.5 + 0.5 * wave)[:, None]
    return mix * [0.15, 0.5, 0.25] + (1 - mix) * [0.9, 0.85, 0.5]


def _brick(p: np.ndarray) -> np.ndarray:
    row = np.floor(p[:, 1] / 0.11)
    along = (p[:, 0] + p[:, 2]) / 0.2 + 0.5 * (row % 2)
    mortar = ((p[:, 1] / 0.11) % 1 < 0.15) | (along % 1 < 0.1)
    tone = 0.8 + 0.2 * np.sin(12.9 * row + 7.1 * np.floor(along))
    return np.where(mortar[:, None], [0.85, 0.82, 0.78], tone[:, None] * [0.68, 0.3, 0.2])


def _stripes(p: np.ndarray) -> np.ndarray:
    angle = np.arctan2(p[:, 2] - 0.95, p[:, 0] - 0.05)
    return np.where((np.floor(angle * 16 / math.pi) % 2)[:, None] > 0, [0.95, 0.75, 0.1], [0.12, 0.1, 0.3])


def _spiral(p: np.ndarray) -> np.ndarray:
    angle = np.arctan2(p[:, 2] + 0.6, p[:, 0] - 0.95)
    band = (angle / (2 * math.pi) + 4 * p[:, 1]) % 1
    return np.where(band[:, None] < 0.5, [0.93, 0.93, 0.95], [0.8, 0.15, 0.2])


def _sky(p: np.ndarray) -> np.ndarray:
    height = p[:, 1] / _SKY_RADIUS
    angle = np.arctan2(*np.ascontiguousarray(p.T[[2, 0]]))  # of columns numpy 1.26 gives one of two results
    hills = 0.06 + 0.05 * np.sin(3 * angle) + 0.03 * np.sin(7 * angle + 1)
    up = np.clip((height - hills) / 0.8, 0, 1)[:, None]
    sky = (1 - up) * [0.8, 0.88, 0.95] + up * [0.25, 0.45, 0.8]
    ground = np.array([0.32, 0.42, 0.22]) * (0.85 + 0.15 * np.sin(40 * angle + 60 * height))[:, None]
    return np.where((height < hills)[:, None], ground, sky)


def _corners(vertices: torch.Tensor, faces: torch.Tensor) -> np.ndarray:
    return vertices[faces.long()].double().numpy()


def _grid(points: np.ndarray) -> np.ndarray:
    """Triangles of a grid of points (rows, columns, 3)."""
    a, b, c, d = points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]
    return np.concatenate([np.stack(t, axis=2).reshape(-1, 3, 3) for t in ((a, b, c), (a, c, d))])


def _disc(radius: float, rings: int, sectors: int) -> np.ndarray:
    r, angle = np.meshgrid(np.linspace(0, radius, rings), np.linspace(0, 2 * math.pi, sectors), indexing="ij")
    return _grid(np.stack([r * np.sin(angle), np.zeros_like(r), r * np.cos(angle)], axis=2))[:, ::-1]


def _box(center: tuple[float, ...], half: tuple[float, ...], turn: float, cells: int) -> np.ndarray:
    line = np.linspace(-1, 1, cells + 1)
    u, v = np.meshgrid(line, line, indexing="ij")
    sides = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            points = np.empty((*u.shape, 3))
            points[..., axis] = sign
            points[..., (axis + 1) % 3], points[..., (axis + 2) % 3] = (u, v) if sign > 0 else (v, u)
            sides.append(_grid(points))
    corners = np.concatenate(sides) * half
    cosine, sine = math.cos(turn), math.sin(turn)
    return corners @ np.array([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]]) + center


def _torus(center: tuple[float, ...], radius: float, tube: float) -> np.ndarray:
    a, b = np.meshgrid(np.linspace(0, 2 * math.pi, 97), np.linspace(0, 2 * math.pi, 33), indexing="ij")
    ring = radius + tube * np.cos(b)
    return _grid(np.stack([ring * np.cos(a), tube * np.sin(b), ring * np.sin(a)], axis=2))[:, ::-1] + center


def _cone(base: tuple[float, ...], radius: float, height: float) -> np.ndarray:
    h, angle = np.meshgrid(np.linspace(0, 1, 65), np.linspace(0, 2 * math.pi, 97), indexing="ij")
    ring = radius * (1 - h)
    return _grid(np.stack([ring * np.cos(angle), height * h, ring * np.sin(angle)], axis=2))[:, ::-1] + base
