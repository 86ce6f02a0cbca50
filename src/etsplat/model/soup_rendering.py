"""Pictures of a triangle soup: the same call in training and when a finished soup is drawn."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.core.rasterization import Rasterization
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.ops.rasterize import rasterize
from etsplat.ops.rasterize_hard import render_opaque
from etsplat.ops.soup_activation import soup_activation
from etsplat.ops.soup_colors import soup_colors

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
        cull_large: leave out triangles with a vertex farther from their middle than this times the image's longer side.
            Beside the camera triangles are stretched without bound, and would cover images that they are not in.
        freeze_incentre: with distance "sdf", hold the inradius constant in the backward pass, as Triangle Splatting.
        near_plane: triangles with a vertex at this depth or nearer are invisible.
        opacity_floor: opacities are squeezed into [floor, 1].
        sigma_ceiling: softness is cut here.
    """

    kernel: str = "elastic"
    distance: str = "barycentric"
    sh_degree: int | None = None
    cull_small: bool = False
    cull_large: float = float("inf")
    freeze_incentre: bool = False
    near_plane: float = 0.01
    opacity_floor: float = 0.0
    sigma_ceiling: float = float("inf")

    def opacities(self, soup: TriangleSoup) -> Float[Tensor, " N"]:
        """What is drawn: o' = floor + (1 - floor) o."""
        if self.opacity_floor == 0.0:
            return soup.opacities
        return self.opacity_floor + (1.0 - self.opacity_floor) * soup.opacities

    def degree(self, soup: TriangleSoup) -> int:
        """Of the bands of the colours that are used."""
        return soup.sh_degree if self.sh_degree is None else min(self.sh_degree, soup.sh_degree)

    def sigma(self, soup: TriangleSoup) -> Float[Tensor, " N"]:
        """What is drawn: the smaller of sigma and the ceiling."""
        return soup.sigma if self.sigma_ceiling == float("inf") else soup.sigma.clamp_max(self.sigma_ceiling)


def render_soup(
    soup: TriangleSoup,
    cameras: Cameras,
    appearance: SoupAppearance,
    *,
    limits: Float[Tensor, "2"] | None = None,
    backgrounds: Float[Tensor, "B 3"] | None = None,
    depth: Literal["plane", "centroid"] | None = None,
    median_depth: bool = False,
    normals: bool = False,
    distortion: bool = False,
    statistics: bool = False,
) -> Rasterization:
    """Splat a soup into the images of B cameras; differentiable with respect to its parameters.

    Args:
        soup: N triangles.
        cameras: B cameras of one image size.
        appearance: kernel and switches.
        limits: (2,) in place of the appearance's opacity floor and sigma ceiling, in device memory.
        backgrounds: (B, 3); None is black.
        depth: as in `rasterize`, and so are the other images.
        median_depth: also return the median depth.
        normals: also return normals.
        distortion: also return the distortion.
        statistics: also return per-triangle statistics.
    """
    degree = appearance.degree(soup)
    colors = soup_colors(soup.vertices, soup.sh_dc, soup.sh_rest, cameras.centers, degree)
    opacities, sigma = soup_activation(
        soup.vertices,
        soup.opacity_logits,
        soup.sigma_raw,
        (appearance.opacity_floor, appearance.sigma_ceiling) if limits is None else limits,
        cameras if appearance.cull_small or appearance.cull_large < float("inf") else None,
        smallest=SMALLEST_INRADIUS if appearance.cull_small else 0.0,
        largest=appearance.cull_large * max(cameras.width, cameras.height),
    )
    return rasterize(
        soup.vertices,
        colors,
        opacities,
        sigma,
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
    )


@torch.no_grad()
def render_soup_opaque(
    soup: TriangleSoup,
    cameras: Cameras,
    appearance: SoupAppearance,
    *,
    background: Float[Tensor, "3"] | None = None,
    supersampling: int = 4,
) -> Float[Tensor, "B H W 3"]:
    """Draw a soup as a mesh viewer would: sharp opaque triangles with a z-buffer, colours as each camera sees them.

    Args:
        soup: N triangles; those with an opacity below one half are left out.
        cameras: B cameras of one image size.
        appearance: of the opacities and colours.
        background: (3,); None is black.
        supersampling: samples along each axis of a pixel.
    """
    degree = appearance.degree(soup)
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
            face_colors=soup_colors(vertices, dc, rest, camera.centers, degree)[0],
            supersampling=supersampling,
            near_plane=appearance.near_plane,
        )
        behind = 0.0 if background is None else (1 - rgba[..., 3:]) * background
        images.append(rgba[..., :3] + behind)
    return torch.cat(images)
