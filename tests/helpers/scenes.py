"""Scenes for rasterizer tests, and calls that run one on an engine in its precision."""

from typing import Any

import torch
from torch import Tensor

import etsplat
from etsplat import Cutoffs, Rasterization, intrinsics, look_at
from etsplat.core.rasterization import OUTPUTS
from etsplat.geometry.icosphere import icosphere
from helpers.engines import device_of, dtype_of, moved

NO_CUTOFFS = Cutoffs(alpha_min=0.0, alpha_max=1.0, x_max=float("inf"), transmittance_min=0.0)
IMAGES = ("color", "alpha", "depth", "median_depth", "normal", "distortion")
EVERYTHING: dict[str, Any] = {"outputs": OUTPUTS}
DIFFERENTIABLE = (
    "vertices",
    "face_colors",
    "vertex_colors",
    "corner_colors",
    "opacities",
    "sigma",
    "viewmats",
    "Ks",
    "backgrounds",
)

Scene = dict[str, Any]


def cameras(width: int, height: int, views: int = 2) -> Scene:
    """Cameras 4 away from the origin with fx != fy and the principal point off the centre."""
    eyes = torch.tensor([[0.0, 0.0, 4.0], [2.5, 1.5, -2.5], [-3.0, -2.0, 1.0]])[:views]
    K = intrinsics(45, width, height)
    K[0, 0] *= 1.1
    K[:2, 2] += torch.tensor([0.37, -0.21])
    return {
        "viewmats": look_at(eyes, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])),
        "Ks": K.expand(len(eyes), 3, 3).contiguous(),
        "width": width,
        "height": height,
    }


def soup(rng: torch.Generator, count: int, width: int = 48, height: int = 40, **options: Any) -> Scene:
    """Random separate triangles around the origin, none of them a sliver; options: size, channels, views."""
    size, channels, views = options.get("size", 0.5), options.get("channels", 3), options.get("views", 2)
    centres = torch.randn(count, 1, 3, generator=rng) * 0.7
    angles = torch.tensor([0.0, 2.1, 4.2]) + 0.5 * torch.randn(count, 3, generator=rng).clamp(-1, 1)
    frames = torch.linalg.qr(torch.randn(count, 3, 3, generator=rng))[0][:, :2]
    corners = torch.stack([angles.cos(), angles.sin()], dim=-1) @ frames
    return {
        "vertices": centres + size * torch.rand(count, 1, 1, generator=rng) * corners,
        "face_colors": torch.rand(count, channels, generator=rng),
        "opacities": 0.2 + 0.75 * torch.rand(count, generator=rng),
        "sigma": 0.15 + torch.rand(count, generator=rng),
        "backgrounds": torch.rand(views, channels, generator=rng),
        **cameras(width, height, views),
    }


def mesh(rng: torch.Generator, level: int = 2, width: int = 48, height: int = 40) -> Scene:
    """A dented icosphere with shared vertices and one sigma."""
    vertices, faces = icosphere(level)
    vertices = vertices * (1.0 + 0.1 * torch.randn(len(vertices), 1, generator=rng))
    return {
        "vertices": vertices,
        "faces": faces,
        "face_colors": torch.rand(len(faces), 3, generator=rng),
        "opacities": 0.5 + 0.5 * torch.rand(len(faces), generator=rng),
        "sigma": torch.tensor(0.4),
        "backgrounds": torch.rand(2, 3, generator=rng),
        **cameras(width, height),
    }


def colored(layout: str, rng: torch.Generator) -> Scene:
    """A scene with colours "per_view", or interpolated ones "per_corner" or, of a mesh, "per_vertex"."""
    scene = mesh(rng) if layout == "per_vertex" else soup(rng, 80)
    if layout == "per_view":
        return {**scene, "face_colors": torch.rand(2, 80, 3, generator=rng)}
    del scene["face_colors"]
    if layout == "per_vertex":
        return {**scene, "vertex_colors": torch.rand(len(scene["vertices"]), 3, generator=rng)}
    return {**scene, "corner_colors": torch.rand(80, 3, 3, generator=rng)}


def facing(corners: list[tuple[float, float]], z: float = 2.0, size: int = 16, opacity: float = 0.9) -> Scene:
    """One triangle in the plane z whose projection has the given pixel coordinates, seen from the origin along +z."""
    focal, middle = float(size), size / 2
    pixels = torch.tensor(corners)
    points = torch.cat([(pixels - middle) * z / focal, torch.full((3, 1), z)], dim=1)
    return {
        "vertices": points[None],
        "face_colors": torch.tensor([[0.25, 0.5, 1.0]]),
        "opacities": torch.tensor([opacity]),
        "sigma": torch.tensor(0.7),
        "viewmats": torch.eye(4)[None],
        "Ks": torch.tensor([[[focal, 0.0, middle], [0.0, focal, middle], [0.0, 0.0, 1.0]]]),
        "width": size,
        "height": size,
    }


def stacked(*scenes: Scene) -> Scene:
    """The triangles of several ``facing`` scenes, in this order."""
    joined = {name: torch.cat([scene[name] for scene in scenes]) for name in ("vertices", "face_colors", "opacities")}
    return {**scenes[0], **joined}


def accuracy(engine: str) -> float:
    """Relative error that a well-conditioned image may have."""
    return 1e-11 if engine == "reference" else 2e-5


def prepare(scene: Scene, engine: str, dtype: torch.dtype | None = None, requires_grad: bool = False) -> Scene:
    """The scene in the engine's precision, on its device; its floating-point tensors are fresh leaves."""
    prepared = dict(scene)
    for name, value in scene.items():
        if isinstance(value, Tensor) and value.is_floating_point():
            value = value.detach().clone().to(device_of(engine), dtype or dtype_of(engine))
            prepared[name] = value.requires_grad_(requires_grad and name in DIFFERENTIABLE)
        elif isinstance(value, Tensor):
            prepared[name] = value.to(device_of(engine))
    return prepared


def render(scene: Scene, engine: str, **options: Any) -> Rasterization:
    """The pictures, on the CPU."""
    arguments = {**prepare(scene, engine), **options}
    with etsplat.engine(engine):
        return moved(etsplat.rasterize(**arguments), "cpu")


def gradients(
    scene: Scene, engine: str, cotangents: dict[str, Tensor], dtype: torch.dtype | None = None, **options: Any
) -> tuple[Rasterization, dict[str, Tensor]]:
    """Run forward and backward; ``cotangents`` are dL/d(image) by the image's name. What comes out is on the CPU."""
    prepared = prepare(scene, engine, dtype, requires_grad=True)
    with etsplat.engine(engine):
        out = etsplat.rasterize(**{**prepared, **options})
    loss = sum(
        (getattr(out, name) * cotangent.to(prepared["vertices"])).sum() for name, cotangent in cotangents.items()
    )
    assert isinstance(loss, Tensor)
    loss.backward()
    leaves = {name: prepared[name] for name in DIFFERENTIABLE if isinstance(prepared.get(name), Tensor)}
    grads = {name: torch.zeros_like(t) if t.grad is None else t.grad for name, t in leaves.items()}
    return moved(out, "cpu"), moved(grads, "cpu")
