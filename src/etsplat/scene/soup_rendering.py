"""Pictures of a triangle soup: the same call in training and when a finished soup is drawn."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.core.rasterization import Rasterization
from etsplat.ops.rasterize import rasterize
from etsplat.ops.rasterize_hard import render_opaque
from etsplat.ops.soup_colors import soup_colors
from etsplat.scene.triangle_soup import TriangleSoup

SMALLEST_INRADIUS = 1.0
"""Triangle Splatting draws no triangle whose inscribed circle on the image is smaller, in pixels."""

OPAQUE_FROM = 0.5
"""Where a soup is drawn opaque, fainter triangles are left out."""


@dataclass(frozen=True)
class SoupAppearance:
    """How the numbers of a soup become pictures.

    Attributes:
        kernel: "elastic", "bilateral" or "single_sided".
        distance: "barycentric" or "sdf".
        sh_degree: highest band of the colours that is used; None for all that the soup has.
        cull_small: leave out triangles with an inradius below one pixel, as Triangle Splatting does.
        freeze_incentre: with distance "sdf", hold the inradius constant in the backward pass, as Triangle Splatting.
        near_plane: triangles with a vertex at this depth or nearer are invisible.
        opacity_floor: opacities are squeezed into [floor, 1].
        sigma_ceiling: softness is cut here.
    """

    kernel: str = "elastic"
    distance: str = "barycentric"
    sh_degree: int | None = None
    cull_small: bool = False
    freeze_incentre: bool = False
    near_plane: float = 0.01
    opacity_floor: float = 0.0
    sigma_ceiling: float = float("inf")

    def opacities(self, soup: TriangleSoup) -> Float[Tensor, " N"]:
        """What is drawn: o' = floor + (1 - floor) o."""
        if self.opacity_floor == 0.0:
            return soup.opacities
        return self.opacity_floor + (1.0 - self.opacity_floor) * soup.opacities

    def sigma(self, soup: TriangleSoup) -> Float[Tensor, " N"]:
        """What is drawn: the smaller of sigma and the ceiling."""
        return soup.sigma if self.sigma_ceiling == float("inf") else soup.sigma.clamp_max(self.sigma_ceiling)


def render_soup(
    soup: TriangleSoup,
    cameras: Cameras,
    appearance: SoupAppearance,
    *,
    backgrounds: Float[Tensor, "B 3"] | None = None,
    depth: Literal["plane", "centroid"] | None = None,
    median_depth: bool = False,
    normals: bool = False,
    distortion: bool = False,
    statistics: bool = False,
    engine: str | None = None,
) -> Rasterization:
    """Splat a soup into the images of B cameras; differentiable with respect to its parameters.

    Args:
        soup: N triangles.
        cameras: B cameras of one image size.
        appearance: kernel and switches.
        backgrounds: (B, 3); None is black.
        depth: as in `rasterize`, and so are the other images.
        median_depth: also return the median depth.
        normals: also return normals.
        distortion: also return the distortion.
        statistics: also return per-triangle statistics.
        engine: "reference", "cpu" or None (by dtype and device).
    """
    degree = soup.sh_degree if appearance.sh_degree is None else min(appearance.sh_degree, soup.sh_degree)
    colors = soup_colors(soup.vertices, soup.sh_dc, soup.sh_rest, cameras.centers, degree, engine=engine)
    opacities = appearance.opacities(soup)
    if appearance.cull_small:
        opacities = torch.where(small_triangles(soup.vertices, cameras), 0.0, opacities)
    return rasterize(
        soup.vertices,
        colors,
        opacities,
        appearance.sigma(soup),
        cameras.viewmats,
        cameras.Ks,
        cameras.width,
        cameras.height,
        kernel=appearance.kernel,
        distance=appearance.distance,
        backgrounds=backgrounds,
        depth=depth,
        median_depth=median_depth,
        normals=normals,
        distortion=distortion,
        statistics=statistics,
        near_plane=appearance.near_plane,
        freeze_incentre=appearance.freeze_incentre,
        validate=False,
        engine=engine,
    )


@torch.no_grad()
def render_soup_opaque(
    soup: TriangleSoup,
    cameras: Cameras,
    appearance: SoupAppearance,
    *,
    background: Float[Tensor, "3"] | None = None,
    supersampling: int = 4,
    engine: str | None = None,
) -> Float[Tensor, "B H W 3"]:
    """Draw a soup as a mesh viewer would: sharp opaque triangles with a z-buffer, colours as each camera sees them.

    Args:
        soup: N triangles; those with an opacity below one half are left out.
        cameras: B cameras of one image size.
        appearance: of the opacities and colours.
        background: (3,); None is black.
        supersampling: samples along each axis of a pixel.
        engine: "reference", "cpu" or None (by dtype and device).
    """
    degree = soup.sh_degree if appearance.sh_degree is None else min(appearance.sh_degree, soup.sh_degree)
    kept = appearance.opacities(soup) >= OPAQUE_FROM
    vertices, dc, rest = (tensor.detach()[kept] for tensor in (soup.vertices, soup.sh_dc, soup.sh_rest))
    images = []
    for index in range(len(cameras)):
        camera = cameras[index]
        rgba = render_opaque(
            vertices,
            camera.viewmats,
            camera.Ks,
            camera.width,
            camera.height,
            face_colors=soup_colors(vertices, dc, rest, camera.centers, degree, engine=engine)[0],
            supersampling=supersampling,
            near_plane=appearance.near_plane,
            engine=engine,
        )
        behind = 0.0 if background is None else (1 - rgba[..., 3:]) * background
        images.append(rgba[..., :3] + behind)
    return torch.cat(images)


@torch.no_grad()
def small_triangles(vertices: Float[Tensor, "N 3 3"], cameras: Cameras) -> Bool[Tensor, " N"]:
    """Which triangles have an inradius below one pixel in the one camera given: 2 area / perimeter, projected.

    Raises:
        ValueError: more than one camera.
    """
    if len(cameras) != 1:
        raise ValueError(f"cameras must be one where small triangles are left out, got {len(cameras)}")
    rotation, translation = cameras.viewmats[0, :3, :3], cameras.viewmats[0, :3, 3]
    points = vertices.detach() @ rotation.T + translation
    pixels = points[..., :2] / points[..., 2:].clamp_min(1e-6) * torch.diagonal(cameras.Ks[0])[:2]
    edges = pixels - pixels.roll(1, dims=1)
    doubled = (edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]).abs()
    return doubled < SMALLEST_INRADIUS * edges.norm(dim=-1).sum(dim=-1)
