"""The scenes that the GPU engine is measured on: those of benchmarks.scenes, and a soup of four million triangles."""

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

import etsplat
from benchmarks import scenes
from etsplat.core.rasterization import Rasterization
from etsplat.ops.soup_colors import soup_colors

NAMES = ("sphere6", "soup100000", "soup4m")
SOUP_SIZE = (1237, 822)
SOUP_COUNT = 4_000_000


@dataclass
class GpuScene:
    """Leaves on the device, one camera, the gradient that reaches the image; with ``sh``, view-dependent colours.

    ``options`` are further arguments of `etsplat.rasterize`.
    """

    name: str
    vertices: Tensor
    faces: Tensor | None
    colors: Tensor | None
    vertex_colors: Tensor | None
    sh: tuple[Tensor, Tensor] | None
    opacities: Tensor
    sigma: Tensor
    viewmats: Tensor
    Ks: Tensor
    cotangent: Tensor
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def leaves(self) -> list[Tensor]:
        """What gradients are asked for."""
        colors = [t for t in (self.colors, self.vertex_colors, *(self.sh or ())) if t is not None]
        return [self.vertices, *colors, self.opacities, self.sigma]

    def render(self) -> Rasterization:
        """A training step's rendering."""
        height, width = self.cotangent.shape[1:3]
        with etsplat.engine("cuda"):
            if self.sh is None:
                colors = self.colors
            else:
                centers = -torch.einsum("bji,bj->bi", self.viewmats[:, :3, :3], self.viewmats[:, :3, 3])
                colors = soup_colors(self.vertices, *self.sh, centers, 3)
            return etsplat.rasterize(
                self.vertices,
                opacities=self.opacities,
                sigma=self.sigma,
                face_colors=colors,
                vertex_colors=self.vertex_colors,
                viewmats=self.viewmats,
                Ks=self.Ks,
                width=width,
                height=height,
                faces=self.faces,
                validate=False,
                **self.options,
            )


def load(name: str, device: str) -> GpuScene:
    """A scene of benchmarks.scenes, or "soup4m": 4 million triangles with harmonics of degree 3 at 1237 x 822."""
    if name == "soup4m":
        return _large_soup(torch.device(device))
    scene = scenes.load(name)

    def leaf(tensor: Tensor) -> Tensor:
        return tensor.detach().to(device).requires_grad_()

    return GpuScene(
        name,
        leaf(scene.vertices),
        None if scene.faces is None else scene.faces.to(device),
        None if scene.colors is None else leaf(scene.colors),
        None if scene.vertex_colors is None else leaf(scene.vertex_colors),
        None,
        leaf(scene.opacities),
        leaf(scene.sigma),
        scene.viewmats.to(device),
        scene.Ks.to(device),
        scene.cotangent.to(device),
    )


def _large_soup(device: torch.device) -> GpuScene:
    """Like a trained scene: small triangles, most of them near the middle, opacities spread, about 6 pixels across."""
    generator = torch.Generator(device).manual_seed(0)
    count, (width, height) = SOUP_COUNT, SOUP_SIZE

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, device=device)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, device=device)

    vertices = 0.6 * normal(count, 1, 3) + 0.006 * normal(count, 3, 3)
    viewmats = torch.eye(4, device=device)[None].clone()
    viewmats[0, 2, 3] = 3.0
    Ks = torch.tensor([[[1000.0, 0.0, width / 2], [0.0, 1000.0, height / 2], [0.0, 0.0, 1.0]]], device=device)
    sh = (uniform(count, 1, 3).requires_grad_(), (0.05 * normal(count, 15, 3)).requires_grad_())
    return GpuScene(
        "soup4m",
        vertices.requires_grad_(),
        None,
        None,
        None,
        sh,
        (0.05 + 0.9 * uniform(count)).requires_grad_(),
        (0.1 + 0.9 * uniform(count)).requires_grad_(),
        viewmats,
        Ks,
        uniform(1, height, width, 3) - 0.5,
    )
