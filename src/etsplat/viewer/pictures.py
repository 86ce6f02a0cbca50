"""What the viewer shows of a soup, in each of its modes."""

import io
import math
from typing import Literal, get_args

import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.data.dataset import Dataset
from etsplat.data.pictures import as_float
from etsplat.geometry.regions import Region
from etsplat.io.images import over_background, resize_image, to_8_bit
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.ops.rasterize_opaque import rasterize_opaque
from etsplat.ops.soup_colors import soup_colors
from etsplat.tasks.render_config import RenderConfig
from etsplat.tasks.render_soup import color_depth, depth_span, draw

Mode = Literal["soft", "opaque", "depth", "normal", "wireframe"]
MODES: tuple[Mode, ...] = get_args(Mode)

_NEAR, _TURNED = 0.005, math.radians(1)
"""At a photo is who is within that part of the capture's extent of it, and turned by no more than that."""

_MAT = 32
"""Grey around a photo and the picture beside it."""

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
    # Without antialiasing: small pictures are there to be quick.
    config = RenderConfig(opaque=mode == "opaque", depth=mode == "depth", normals=mode == "normal", antialias=False)
    pictures = draw(soup, camera, config)
    if mode == "depth":
        return to_8_bit(color_depth(pictures["depth"], depth_span(pictures["depth"])))
    return to_8_bit(pictures["normal" if mode == "normal" else "color"])


@torch.no_grad()
def beside_photo(
    soup: TriangleSoup, camera: Cameras, mode: Mode, capture: Dataset, index: int
) -> UInt8[Tensor, "H W 3"]:
    """A photo, and to the right of it what `picture` shows in its shape, in a picture of the camera's size.

    A camera that stands at the photo is taken for the photo's own: browsers do not tilt their heads.
    """
    canvas = torch.full((camera.height, camera.width, 3), _MAT, dtype=torch.uint8)
    half, (width, height) = max(1, camera.width // 2), capture.images.sizes[index]
    scale = min(half / width, camera.height / height)
    width, height = max(1, int(scale * width)), max(1, int(scale * height))
    top, left = (camera.height - height) // 2, (half - width) // 2
    photo = resize_image(as_float(capture.images[index]), width, height)
    if photo.shape[-1] == 4:
        photo = over_background(photo, torch.tensor(soup.appearance.background))
    own = capture.cameras[index]
    if stands_at(camera, own, _NEAR * capture.extent):
        K = own.Ks * torch.tensor([width / own.width, height / own.height, 1])[:, None]
        drawn = picture(soup, Cameras(own.viewmats, K, width, height), mode)
    else:
        zoom = float(camera.Ks[0, 1, 1]) * height / camera.height  # the same vertical field of view
        K = torch.tensor([[[zoom, 0, width / 2], [0, zoom, height / 2], [0, 0, 1]]])
        drawn = picture(soup, Cameras(camera.viewmats, K, width, height), mode)
    canvas[top : top + height, left : left + width] = to_8_bit(photo)
    canvas[top : top + height, half + left : half + left + width] = drawn
    return canvas


def stands_at(camera: Cameras, other: Cameras, distance: float) -> bool:
    """Whether a single camera is so near to another, and looks within a degree of where that looks."""
    apart = float((camera.centers[0] - other.centers[0]).norm())
    return apart <= distance and float(camera.viewmats[0, 2, :3] @ other.viewmats[0, 2, :3]) > math.cos(_TURNED)


def png_of(pixels: UInt8[Tensor, "H W 3"]) -> bytes:
    """A PNG file of a picture."""
    file = io.BytesIO()
    Image.fromarray(pixels.numpy()).save(file, "PNG")
    return file.getvalue()


@torch.no_grad()
def cropped(soup: TriangleSoup, crop: Region | None) -> TriangleSoup:
    """The triangles whose centroids lie within a crop; the soup itself without one."""
    if crop is None:
        return soup
    return soup.kept(crop.holds(soup.vertices.mean(dim=1)))


def _wireframe(soup: TriangleSoup, camera: Cameras) -> Float[Tensor, "H W 3"]:
    """Flat triangles, dark where the triangle of the pixel to the right or below is another one."""
    appearance, kept = soup.appearance, soup.seen_opaque
    camera = camera.to(soup.vertices.device)
    image = torch.tensor(appearance.background).to(soup.vertices).expand(camera.height, camera.width, 3)
    if not bool(kept.any()):
        return image
    chosen = soup.kept(kept)
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
