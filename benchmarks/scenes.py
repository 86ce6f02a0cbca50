"""The scenes that the rasterizer is measured on: name -> tensors, the same on every machine."""

import math
import re
from dataclasses import dataclass

import torch
from torch import Tensor

import etsplat
from etsplat.core.kernels import KERNELS
from etsplat.core.rasterization import Rasterization
from etsplat.geometry.icosphere import icosphere

SIZE = 1024
VERTEX_COLORS = "-vertex"  # at the end of a name: colours at the vertices instead of constant ones
REGISTERED = "-registered"  # ... the elastic kernel registered from Python, that is, read from a table
NAMES = ("sphere4", "sphere5", "sphere6", "sphere7", "soup100000", "sphere6-vertex", "sphere6-registered")


@dataclass
class Scene:
    """Leaves of the graph, one camera, and the gradient that reaches the image."""

    name: str
    vertices: Tensor
    faces: Tensor | None
    colors: Tensor | None
    vertex_colors: Tensor | None
    opacities: Tensor
    sigma: Tensor
    viewmats: Tensor
    Ks: Tensor
    cotangent: Tensor
    kernel: str

    @property
    def leaves(self) -> tuple[Tensor, ...]:
        """What gradients are asked for."""
        colors = self.vertex_colors if self.colors is None else self.colors
        assert colors is not None
        return self.vertices, colors, self.opacities, self.sigma

    def render(self) -> Rasterization:
        """One call of the public API."""
        return etsplat.rasterize(
            self.vertices,
            opacities=self.opacities,
            sigma=self.sigma,
            face_colors=self.colors,
            vertex_colors=self.vertex_colors,
            viewmats=self.viewmats,
            Ks=self.Ks,
            width=SIZE,
            height=SIZE,
            faces=self.faces,
            kernel=self.kernel,
        )


def load(name: str) -> Scene:
    """Scene "sphere<level>" or "soup<number of triangles>", "-vertex" or "-registered" after it or not."""
    match = re.fullmatch(rf"(sphere|soup)(\d+)({VERTEX_COLORS}|{REGISTERED})?", name)
    if match is None:
        endings = f"{VERTEX_COLORS} or {REGISTERED}"
        raise SystemExit(f"no scene {name}: choose sphere<level> or soup<triangles>, {endings} after it or not")
    builder = displaced_sphere if match[1] == "sphere" else random_soup
    vertices, faces, colors, opacities, sigma = builder(int(match[2]))
    vertex_colors = None
    kernel = "elastic"
    if match[3] == REGISTERED:
        kernel = "registered"
        etsplat.register_kernel(kernel, KERNELS["elastic"].value)
    if match[3] == VERTEX_COLORS:
        colors, vertex_colors = None, 0.5 + 0.5 * vertices
    generator = torch.Generator().manual_seed(1)
    cotangent = torch.rand(1, SIZE, SIZE, 3, generator=generator) - 0.5
    viewmats = torch.eye(4)[None].clone()
    viewmats[0, 2, 3] = 3.0
    focal = 1.3 * SIZE
    Ks = torch.tensor([[[focal, 0.0, SIZE / 2], [0.0, focal, SIZE / 2], [0.0, 0.0, 1.0]]])
    scene = Scene(name, vertices, faces, colors, vertex_colors, opacities, sigma, viewmats, Ks, cotangent, kernel)
    for leaf in scene.leaves:
        leaf.requires_grad_()
    return scene


def displaced_sphere(level: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """A bumpy icosphere, 20 * 4^level faces; formula and camera of the prototype."""
    vertices, faces = icosphere(level)
    # turned so that a pole goes to (0, 1, golden ratio) and a neighbour of it to (0, -1, golden ratio)
    golden = (1 + math.sqrt(5)) / 2
    pole = torch.tensor([0.0, 1.0, golden]) / math.hypot(1.0, golden)
    side = torch.tensor([0.0, -golden, 1.0]) / math.hypot(1.0, golden)
    vertices = vertices @ torch.stack([side, torch.linalg.cross(pole, side), pole])
    x, y, z = vertices.unbind(1)
    radius = 0.8 + 0.15 * torch.sin(7 * x) * torch.cos(6 * y + 3 * z)
    colors = torch.tensor([0.5, 0.6, 0.7]).repeat(len(faces), 1)
    return vertices * radius[:, None], faces, colors, torch.full((len(faces),), 0.95), torch.tensor(0.5)


def random_soup(count: int) -> tuple[Tensor, None, Tensor, Tensor, Tensor]:
    """Triangles of about 20 pixels all over the view, each with its own opacity and sigma."""
    generator = torch.Generator().manual_seed(0)
    center = 2 * torch.rand(count, 1, 3, generator=generator) - 1
    vertices = center + 0.015 * torch.randn(count, 3, 3, generator=generator)
    colors = torch.rand(count, 3, generator=generator)
    opacities = 0.05 + 0.95 * torch.rand(count, generator=generator)
    sigma = 0.1 + 0.9 * torch.rand(count, generator=generator)
    return vertices, None, colors, opacities, sigma
