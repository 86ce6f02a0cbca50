"""An opaque mesh in the place of a soup, for all that draws soups opaque, crops and exports them."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from etsplat.core.cameras import Cameras
from etsplat.io.mesh_files import MeshFile
from etsplat.model.soup_appearance import SoupAppearance
from etsplat.model.triangle_soup import TriangleSoup
from etsplat.ops.rasterize_opaque import render_opaque

_OPACITY, _SIGMA = 0.999, 0.02


@dataclass
class SolidSoup(TriangleSoup):
    """The faces of a mesh as N separate triangles, all opaque and sharp.

    Attributes:
        corner_colors: (N, 3, 3) in [0, 1], of each corner; a triangle's own colour is their mean.
    """

    corner_colors: Float[Tensor, "N 3 3"] = field(default_factory=lambda: torch.zeros(0, 3, 3))

    @classmethod
    def of(cls, mesh: MeshFile, soup: TriangleSoup) -> "SolidSoup":
        """The faces of a mesh with colours at its vertices, drawn, and noted, as a soup of the same scene; detached."""
        assert mesh.vertex_colors is not None
        corners, colors = mesh.vertices[mesh.faces], mesh.vertex_colors[mesh.faces]
        return cls.of_corners(corners, colors, soup.appearance.structure, soup.notes).to(soup.vertices.device)

    @classmethod
    def of_corners(
        cls,
        vertices: Float[Tensor, "N 3 3"],
        colors: Float[Tensor, "N 3 3"],
        appearance: SoupAppearance,
        notes: Mapping[str, str],
    ) -> "SolidSoup":
        """Triangles by their corners and the colours of these, in [0, 1]; detached."""
        flat = TriangleSoup.from_triangles(vertices, colors.mean(dim=1), opacity=_OPACITY, sigma=_SIGMA, sh_degree=0)
        return cls(**flat.state(), appearance=appearance, notes=notes, corner_colors=colors)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> "SolidSoup":
        """The same on another device or in another precision."""
        return replace(super().to(device, dtype), corner_colors=self.corner_colors.to(device=device, dtype=dtype))

    def kept(self, rows: Bool[Tensor, " N"]) -> "SolidSoup":
        """Some of the triangles."""
        kept = {name: values.detach()[rows] for name, values in self.parameters().items()}
        return replace(self, **kept, corner_colors=self.corner_colors[rows])

    @torch.no_grad()
    def render_opaque(self, cameras: Cameras, *, supersampling: int = 4) -> Float[Tensor, "B H W 4"]:
        """What a mesh viewer shows: (B, H, W, 4) premultiplied RGBA; colours are interpolated between corners."""
        return render_opaque(
            self.vertices.detach(),
            cameras=cameras,
            corner_colors=self.corner_colors,
            supersampling=supersampling,
            near_plane=self.appearance.near_plane,
        ).rgba
