"""Milliseconds of the operations beside the rasterizer, at the size of a full reconstruction step.

python -m benchmarks.ops --threads 4
"""

import argparse
import math
import statistics
import time
from collections.abc import Callable
from functools import partial

import torch
from rich.console import Console
from rich.table import Table

import etsplat
from etsplat.core.cameras import Cameras, intrinsics, look_at
from etsplat.core.soup_numbers import SoupNumbers
from etsplat.engines.threads import num_threads, one_torch_thread, set_num_threads
from etsplat.geometry.topology import MeshTopology
from etsplat.ops.adam import Adam
from etsplat.ops.mesh_energies import mesh_energies
from etsplat.ops.normal_consistency import normal_consistency
from etsplat.ops.photometric import photometric_loss
from etsplat.ops.rasterize_opaque import rasterize_opaque, render_opaque
from etsplat.ops.soup_activation import soup_activation
from etsplat.ops.spherical_harmonics import spherical_harmonics
from etsplat.ops.triangle_channels import triangle_channels

Operation = tuple[str, str, Callable[[], object]]
_TEXTURE, _PICTURE = 2048, (1600, 1200)


def torus(rings: int, sides: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A closed mesh with 2 rings sides faces that fills the view."""
    u, v = (torch.arange(n) * (2 * math.pi / n) for n in (rings, sides))
    u, v = torch.meshgrid(u, v, indexing="ij")
    radius = 0.65 + (0.35 + 0.02 * torch.sin(9 * u) * torch.cos(5 * v)) * v.cos()
    vertices = torch.stack([radius * u.cos(), radius * u.sin(), 0.35 * v.sin()], dim=-1).reshape(-1, 3)
    i, j = torch.meshgrid(torch.arange(rings), torch.arange(sides), indexing="ij")
    a, b, c, d = (
        ((i + di) % rings * sides + (j + dj) % sides).reshape(-1) for di, dj in [(0, 0), (1, 0), (1, 1), (0, 1)]
    )
    return vertices, torch.cat([torch.stack([a, b, c], 1), torch.stack([a, c, d], 1)])


def rendering(size: int, vertices: torch.Tensor, faces: torch.Tensor) -> list[Operation]:
    viewmats = look_at(torch.tensor([[0.3, 0.4, 3.2]]), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])).float()
    shown = {"cameras": Cameras(viewmats, intrinsics(40.0, size, size).float()[None], size, size), "faces": faces}
    colors, vertex_colors = torch.rand(len(faces), 3), torch.rand(len(vertices), 3)
    shape = f"{size} x {size}, {len(faces):,} faces"
    return [
        ("rasterize_opaque", shape, lambda: rasterize_opaque(vertices, **shown)),
        ("render_opaque 4 x 4", shape, lambda: render_opaque(vertices, **shown, face_colors=colors)),
        (
            "render_opaque 4 x 4, vertex colours",
            shape,
            lambda: render_opaque(vertices, **shown, vertex_colors=vertex_colors),
        ),
    ]


def training(size: int, vertices: torch.Tensor, faces: torch.Tensor) -> list[Operation]:
    color = torch.rand(1, size, size, 3).requires_grad_()
    target, backgrounds = torch.rand(1, size, size, 4), torch.rand(1, 3)
    points = vertices.clone().requires_grad_()
    connectivity = MeshTopology.from_faces(faces, len(vertices)).connectivity
    parameters = {
        "vertices": torch.rand(len(vertices), 3),
        "colors": torch.rand(len(faces), 3),
        "opacities": torch.rand(len(faces)),
        "sigma": torch.rand(()),
    }
    for parameter in parameters.values():
        parameter.requires_grad_().grad = torch.rand(parameter.shape)
    adam = Adam(parameters, dict.fromkeys(parameters, 1e-3))
    elements = sum(parameter.numel() for parameter in parameters.values())
    coefficients = torch.rand(len(faces), 16, 3).requires_grad_()
    directions = torch.randn(len(faces), 3).requires_grad_()

    def photometric() -> None:
        color.grad = None
        photometric_loss(color, target, 0.0, backgrounds=backgrounds).backward()

    def energies() -> None:
        points.grad = None
        edge, normal, laplacian = mesh_energies(points, connectivity)
        (1.5 * edge + 0.01 * normal + 0.5 * laplacian).backward()

    def harmonics() -> None:
        coefficients.grad = directions.grad = None
        spherical_harmonics(coefficients, directions, 3).sum().backward()

    return [
        ("photometric_loss without SSIM, with gradient", f"{size} x {size}", photometric),
        ("mesh_energies, with gradient", f"{len(faces):,} faces", energies),
        ("Adam.step", f"{elements:,} elements", adam.step),
        ("spherical_harmonics 3, with gradient", f"{len(faces):,} points", harmonics),
    ]


def textures(size: int, vertices: torch.Tensor, faces: torch.Tensor) -> list[Operation]:
    """Texture and image of sizes of their own; beside torch's sampling of level 0, on as many threads."""
    texture = torch.rand(_TEXTURE, _TEXTURE, 3).requires_grad_()
    width, height = _PICTURE
    # A surface seen at an angle: neighbouring pixels lie close to each other in the texture.
    rows, columns = torch.meshgrid(torch.linspace(0, 1, height), torch.linspace(0, 1, width), indexing="ij")
    uv = torch.stack([columns * (0.5 + 0.5 * rows), 0.2 * columns + 0.8 * rows], dim=-1).requires_grad_()
    lod = (1.5 * rows).contiguous()
    channels_first = texture.detach().permute(2, 0, 1)[None].contiguous().requires_grad_()
    picture = f"{_TEXTURE} x {_TEXTURE}, {width} x {height}"
    viewmats = look_at(torch.tensor([[0.3, 0.4, 2.2]]), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])).float()
    camera = Cameras(viewmats, intrinsics(40.0, width, height).float()[None], width, height)
    connectivity = MeshTopology.from_faces(faces, len(vertices)).connectivity
    points, face_uvs = vertices.clone().requires_grad_(), vertices[faces][..., :2] * 0.5 + 0.5

    def sample(lod: torch.Tensor | None) -> None:
        texture.grad = uv.grad = None
        etsplat.sample_texture(texture, uv, lod=lod).sum().backward()

    def peer() -> None:
        channels_first.grad = uv.grad = None
        before = torch.get_num_threads()
        torch.set_num_threads(num_threads())
        found = torch.nn.functional.grid_sample(
            channels_first, 2 * uv[None] - 1, mode="bilinear", padding_mode="border", align_corners=False
        )
        found.sum().backward()
        torch.set_num_threads(before)

    def draw() -> None:
        texture.grad = points.grad = None
        etsplat.rasterize_antialiased(
            points, connectivity=connectivity, cameras=camera, texture=texture, face_uvs=face_uvs
        ).color.sum().backward()

    return [
        ("sample_texture, with gradients", picture, partial(sample, None)),
        ("sample_texture between levels, with gradients", picture, partial(sample, lod)),
        ("torch's grid_sample, with gradients", picture, peer),
        ("rasterize_antialiased of a texture, with gradients", f"{picture}, {len(faces):,} faces", draw),
    ]


def soup_losses(size: int, vertices: torch.Tensor, faces: torch.Tensor) -> list[Operation]:
    """What preset paper of novel-view synthesis adds to a step; and in PyTorch, on one thread, as training has it."""
    corners = vertices[faces].clone().requires_grad_()
    viewmats = look_at(torch.tensor([[0.3, 0.4, 3.2]]), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])).float()
    camera = Cameras(viewmats, intrinsics(40.0, size, size).float()[None], size, size)
    normals, depth = torch.rand(1, size, size, 3).requires_grad_(), (2 + torch.rand(1, size, size, 1)).requires_grad_()
    alpha, logits = torch.rand(1, size, size, 1), torch.randn(len(faces)).requires_grad_()

    def agreement() -> None:
        normals.grad = depth.grad = None
        with one_torch_thread():
            normal_consistency(normals, depth, alpha, camera.viewmats, camera.Ks).backward()

    def channels() -> None:
        corners.grad = None
        with one_torch_thread():
            triangle_channels(corners, viewmats, depth=True, normals=True).sum().backward()

    def activation() -> None:
        logits.grad = None
        with one_torch_thread():
            opacities, _ = soup_activation(corners, logits, logits.detach(), SoupNumbers(), camera)
            opacities.sum().backward()

    pixels, triangles = f"{size} x {size}", f"{len(faces):,} triangles"
    named = [("normal_consistency", pixels, agreement), ("triangle_channels", triangles, channels)]
    named.append(("soup_activation", triangles, activation))

    def on(engine: str, run: Callable[[], None]) -> None:
        with etsplat.engine(engine):
            run()

    engines = {"cpu": ", with gradient", "reference": ", in PyTorch"}
    return [(name + tail, at, partial(on, engine, run)) for name, at, run in named for engine, tail in engines.items()]


def milliseconds(operation: Callable[[], object], repeats: int) -> list[float]:
    operation()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        operation()
        times.append(1e3 * (time.perf_counter() - start))
    return times


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=0, help="threads of the native engine; 0: all cores")
    parser.add_argument("--size", type=int, default=1024, help="width and height of the image in pixels")
    parser.add_argument("--rings", type=int, default=224, help="the mesh has 2 rings^2 faces")
    parser.add_argument("--repeats", type=int, default=20)
    arguments = parser.parse_args()
    set_num_threads(arguments.threads)
    torch.manual_seed(0)
    vertices, faces = torus(arguments.rings, arguments.rings)

    table = Table(title=f"Operations beside the rasterizer, {num_threads()} threads, {arguments.repeats} runs each")
    for name, justify in [("operation", "left"), ("size", "left"), ("median ms", "right"), ("best ms", "right")]:
        table.add_column(name, justify=justify, no_wrap=True)
    for build in (rendering, training, textures, soup_losses):
        for name, shape, operation in build(arguments.size, vertices, faces):
            times = milliseconds(operation, arguments.repeats)
            table.add_row(name, shape, f"{statistics.median(times):.2f}", f"{min(times):.2f}")
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
