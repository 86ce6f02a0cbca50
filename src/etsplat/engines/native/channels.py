"""What the native rasterizers share: images as channels, and the depth of a chosen triangle per pixel.

Native code composites channels of two kinds: flat ones, constant over a triangle, and corner ones, interpolated over
it. Depth and normals are channels as well, so their gradients need no code of their own.
"""

import torch
from torch import Tensor

from etsplat.core.rasterization import Rasterization, RasterizeSettings, RasterizeTensors
from etsplat.engines.engine import Engine
from etsplat.engines.native.plan import Geometry, Render
from etsplat.engines.reference.rasterize import barycentrics, perspective_weights, to_screen


class Channels:
    """Flat (N, F) or (B, N, F) and corner (N, 3, K) or (B, N, 3, K) channels; in each, colours come first."""

    def __init__(self, tensors: RasterizeTensors, geometry: Geometry, render: type[Render]) -> None:
        self.flat, self.corner = tensors.face_colors, tensors.corner_colors
        if tensors.vertex_colors is not None and tensors.faces is not None:
            self.corner = render.per_corner(tensors.vertex_colors, tensors.faces, geometry)
        self.flat_is_color = self.flat is not None
        self.colors = self.count
        self.centroid_depth: Tensor | None = None  # (B, N)
        self.flat_names: list[str] = []
        self.corner_names: list[str] = []

    @property
    def count(self) -> int:
        """Of all channels."""
        return sum(t.shape[-1] for t in (self.flat, self.corner) if t is not None)

    @property
    def first_color(self) -> int:
        """Flat channels come first in an image, so a normal or a depth may precede interpolated colours."""
        return 0 if self.flat_is_color or self.flat is None else self.flat.shape[-1]

    def add_geometry(self, tensors: RasterizeTensors, settings: RasterizeSettings, engine: Engine) -> None:
        """Append what the settings ask for of depth and normals, differentiable by vertices and viewmats."""
        depth, normals = settings.wants("depth"), settings.wants("normal")
        centroid = settings.depth_of == "centroid" and settings.wants("depth", "median_depth")
        if not (depth or normals or centroid):
            return
        corners, viewmats = tensors.corners, tensors.viewmats
        batch = len(viewmats)
        if centroid or normals:
            geometry = engine.triangle_channels(corners, viewmats, centroid, normals)
            self.centroid_depth = geometry[..., 0] if centroid else None
            shown = geometry[..., 1:] if centroid and not depth else geometry
            self.flat_names += ["depth"] * (centroid and depth) + ["normal"] * normals
            own = [] if self.flat is None else [self.flat if self.flat.dim() == 3 else self.flat.expand(batch, -1, -1)]
            self.flat = torch.cat([*own, shown], dim=-1) if self.flat_names else self.flat
        if depth and not centroid:
            corners = finite(corners)
            # A camera that is not finite sees nothing, and must not spoil the gradients of the others.
            viewmats = torch.where(viewmats.isfinite().all(dim=2).all(dim=1)[:, None, None], viewmats, 0.0)
            z = torch.einsum("bi,nki->bnk", viewmats[:, 2, :3], corners) + viewmats[:, 2, 3, None, None]
            own = [] if self.corner is None else [self.corner.expand(batch, -1, -1, -1)]
            self.corner = torch.cat([*own, z[..., None]], dim=-1)
            self.corner_names.append("depth")

    def pad_backgrounds(self, backgrounds: Tensor | None) -> Tensor | None:
        """Backgrounds (B, C) of the colours as (B, count), 0 behind everything else."""
        if backgrounds is None or self.count == self.colors:
            return backgrounds
        first = self.first_color
        return torch.nn.functional.pad(backgrounds, (first, self.count - self.colors - first))

    def split(self, result: Rasterization) -> None:
        """Hand the channels of ``result.color`` to the fields they belong to."""
        image = result.color
        if image.shape[-1] == self.colors:
            return
        names = [*(["color"] if self.flat_is_color else []), *self.flat_names]
        names += [*([] if self.flat_is_color else ["color"]), *self.corner_names]
        sizes = [{"color": self.colors, "depth": 1, "normal": 3}[name] for name in names]
        parts = dict(zip(names, torch.split(image, sizes, dim=-1), strict=True))
        result.color = parts["color"]
        result.normal = parts.get("normal")
        if "depth" in parts:
            result.depth = parts["depth"] / result.alpha.clamp_min(1e-8)


def finite(corners: Tensor) -> Tensor:
    """With 0 for triangles that are not finite, which are never drawn."""
    return torch.where(corners.isfinite().all(dim=2).all(dim=1)[:, None, None], corners, 0.0)


def median_depth(triangle: Tensor, channels: Channels, tensors: RasterizeTensors, engine: Engine) -> Tensor:
    """Depth (B, H, W, 1) at each pixel of the triangle whose index + 1 is given, 0 where that is 0; differentiable.

    The depth of the centroid where ``channels`` have it, else that of the triangle's plane at the pixel.
    """
    if len(tensors.opacities) == 0:
        return torch.zeros((*triangle.shape, 1), device=triangle.device)
    if channels.centroid_depth is not None:
        return engine.pick_values(channels.centroid_depth, triangle)[..., None]
    return _plane_depth(triangle, finite(tensors.corners), tensors.viewmats, tensors.Ks)


def _plane_depth(triangle: Tensor, corners: Tensor, viewmats: Tensor, Ks: Tensor) -> Tensor:
    """Every pixel is computed, those without a triangle on a stand-in: how many there are is not asked."""
    stand_in = torch.eye(3, device=corners.device).roll(1, dims=0)
    stand_in[:, 2] = 1.0  # (0, 0, 1), (1, 0, 1), (0, 1, 1), made on the device
    identity = torch.eye(4, device=corners.device)
    height, width = triangle.shape[1:]
    x = torch.arange(width, device=corners.device) + 0.5
    y = torch.arange(height, device=corners.device) + 0.5
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
    viewmats = torch.where(viewmats.isfinite(), viewmats, 0.0)
    images = []
    for viewmat, K, chosen in zip(viewmats, Ks, triangle, strict=True):
        there = chosen > 0
        picked = corners[(chosen.long() - 1).clamp_min(0)] @ viewmat[:3, :3].T + viewmat[:3, 3]
        drawn = there[..., None, None]
        screen, z = to_screen(torch.where(drawn, picked, stand_in), identity, K)
        screen = torch.where(drawn, screen, stand_in[:, :2])  # K may make it degenerate, and would get NaN
        depth = (perspective_weights(barycentrics(pixels, screen), z) * z).sum(dim=-1)
        images.append(torch.where(there, depth, 0.0))
    return torch.stack(images)[..., None]
