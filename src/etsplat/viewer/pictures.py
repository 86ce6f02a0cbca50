"""What the viewer shows of a soup, in each of its modes."""

from dataclasses import replace
from typing import Literal, get_args

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.io.images import to_8_bit
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.ops.rasterize_opaque import rasterize_opaque
from etsplat.ops.soup_colors import soup_colors
from etsplat.tasks.render_config import RenderConfig
from etsplat.tasks.render_soup import color_depth, depth_span, draw

Mode = Literal["soft", "opaque", "depth", "normal", "wireframe"]
MODES: tuple[Mode, ...] = get_args(Mode)

_LINE = 0.25
"""How bright a triangle is where it borders on another in the wireframe."""


@torch.no_grad()
def picture(soup: TriangleSoup, camera: Cameras, mode: Mode) -> UInt8[Tensor, "H W 3"]:
    """One camera's picture, 8 bits.

    Modes: soft is the splatted soup; opaque its triangles above half opacity, sharp, as a mesh viewer draws them; depth
    in false colours, near is red; normals as (n + 1) / 2; wireframe the nearest triangles with their borders.
    """
    if mode == "wireframe":
        return to_8_bit(_wireframe(soup, camera).cpu())
    config = RenderConfig(opaque=mode == "opaque", depth=mode == "depth", normals=mode == "normal")
    pictures = draw(soup, camera, config)
    if mode == "depth":
        return to_8_bit(color_depth(pictures["depth"], depth_span(pictures["depth"])))
    return to_8_bit(pictures["normal" if mode == "normal" else "color"])


def _wireframe(soup: TriangleSoup, camera: Cameras) -> Float[Tensor, "H W 3"]:
    """Flat triangles, dark where the triangle of the pixel to the right or below is another one."""
    appearance, kept = soup.appearance, soup.seen_opaque
    camera = camera.to(soup.vertices.device)
    image = torch.tensor(appearance.background).to(soup.vertices).expand(camera.height, camera.width, 3)
    if not bool(kept.any()):
        return image
    chosen = replace(soup, **{name: tensor[kept] for name, tensor in soup.parameters().items()})
    triangle = rasterize_opaque(chosen.vertices, cameras=camera, near_plane=appearance.near_plane).triangle
    assert triangle is not None
    hit = triangle[0].long()
    view = chosen.vertices, chosen.sh_dc, chosen.sh_rest, camera.centers
    colors = soup_colors(*view, soup.drawn_degree)[0].clamp(0, 1)
    flat = torch.where(hit[..., None] >= 0, colors[hit.clamp_min(0)], image)
    border = torch.zeros_like(hit, dtype=torch.bool)
    border[:, :-1] |= hit[:, 1:] != hit[:, :-1]
    border[:-1] |= hit[1:] != hit[:-1]
    return torch.where(border[..., None], _LINE * flat, flat)
