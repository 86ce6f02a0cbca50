"""What goes into and comes out of the rasterizer, shared by its engines."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from etsplat.core.short_repr import short_repr
from etsplat.core.validation import shown

# Depths that the distortion maps to [0, 1]; those of 2DGS and Triangle Splatting.
DISTORTION_NEAR = 0.2
DISTORTION_FAR = 100.0

SOUP_SIGMA_FLOOR = 0.01
"""No triangle of a soup gets sharper than this."""


class Cutoffs(NamedTuple):
    """Where compositing stops caring. ``Cutoffs(0, 1, inf, 0)`` switches all of them off.

    Attributes:
        alpha_min: A pixel skips a triangle whose alpha is below this; such a triangle is invisible where even its
            opacity is below.
        alpha_max: Alpha is clamped to this, with zero gradient where the clamp acts.
        x_max: A pixel skips a triangle whose distance x exceeds this.
        transmittance_min: A pixel stops for good, without drawing, at the first triangle that would bring the
            transmittance below this. Not 1e-4, because two layers clamped at 0.99 land exactly there.

    Example:
        >>> sharp = etsplat.Cutoffs(alpha_min=0.05)
        >>> sharp.alpha_max
        0.99
    """

    alpha_min: float = 1 / 255
    alpha_max: float = 0.99
    x_max: float = 2.0
    transmittance_min: float = 0.99e-4


DEFAULT_CUTOFFS = Cutoffs()


OUTPUTS = ("color", "alpha", "depth", "median_depth", "normal", "distortion", "statistics")
"""What ``etsplat.rasterize`` can return, the first two always."""

DEPTHS = ("plane", "centroid")


class RasterizeSettings(NamedTuple):
    """The arguments of ``etsplat.rasterize`` that are not tensors; see there."""

    width: int
    height: int
    kernel: str
    distance: str
    outputs: frozenset[str]
    depth_of: str
    near_plane: float
    freeze_inradius: bool
    cutoffs: Cutoffs

    def wants(self, *names: str) -> bool:
        """Whether one of these outputs is asked for."""
        return not self.outputs.isdisjoint(names)


class RasterizeTensors(NamedTuple):
    """The arguments of ``etsplat.rasterize`` that are tensors; see there. Exactly one kind of colours is given."""

    vertices: Tensor
    opacities: Tensor
    sigma: Tensor
    viewmats: Tensor
    Ks: Tensor
    faces: Tensor | None
    face_colors: Tensor | None
    vertex_colors: Tensor | None
    corner_colors: Tensor | None
    backgrounds: Tensor | None

    @property
    def corners(self) -> Float[Tensor, "N 3 3"]:
        """Positions of the corners, differentiable."""
        return self.vertices if self.faces is None else self.vertices[self.faces.long()]


class OpaqueView(NamedTuple):
    """One camera with its image, for the z-buffer; contiguous, without gradients."""

    viewmat: Float[Tensor, "4 4"]
    K: Float[Tensor, "3 3"]
    width: int
    height: int
    near_plane: float


@dataclass(eq=False)
class TriangleStatistics:
    """Per view and triangle, without gradients; all 0 where ``visible`` is False.

    Attributes:
        max_weight: Largest blend weight alpha T over the pixels of the view.
        screen_size: Largest distance from the mean of the projected vertices to one of them, in pixels.
        inradius: Radius of the incircle of the projected triangle, in pixels.
        visible: Passes the culls, and the box of its visible support meets the image.

    Example:
        >>> corners = torch.tensor([[[-0.5, -0.5, 2.0], [0.5, -0.5, 2.0], [0.0, 0.5, 2.0]]])
        >>> camera = etsplat.Cameras(torch.eye(4)[None], etsplat.intrinsics(60.0, 32, 32)[None], 32, 32)
        >>> look = dict(opacities=torch.ones(1), sigma=0.5, face_colors=torch.ones(1, 3))
        >>> seen = etsplat.rasterize(corners, **look, cameras=camera, outputs=("color", "statistics"))
        >>> behind = etsplat.rasterize(-corners, **look, cameras=camera, outputs=("color", "statistics"))
        >>> seen.statistics.visible.item(), behind.statistics.visible.item()
        (True, False)
    """

    __repr__ = short_repr

    max_weight: Float[Tensor, "B N"]
    screen_size: Float[Tensor, "B N"]
    inradius: Float[Tensor, "B N"]
    visible: Bool[Tensor, "B N"]


@dataclass(eq=False)
class Rasterization:
    """Images of the rasterizers; what was not asked for, or what a rasterizer does not have, is None.

    Soft triangles have what ``outputs`` of ``etsplat.rasterize`` names. Opaque ones show the nearest triangle at each
    pixel's centre: they have triangle, barycentrics and depth, of ``render_opaque`` colour and coverage alone.

    Attributes:
        color: Sum of w c, plus T times the background; C is 0 where no colours were given.
        alpha: 1 - T, the opacity of the pixel; of opaque triangles 1 or 0, of ``render_opaque`` the share of samples.
        depth: Sum of w z / max(alpha, 1e-8), view-space z; 0 where the pixel is empty.
        median_depth: z of the triangle at which T falls from above 0.5 to 0.5 or less; 0 where that never happens.
        normal: Sum of w n, unit normals in world space that face the camera; not renormalised.
        distortion: Sum over pairs of w_i w_j (m_i - m_j)^2 with m the depth mapped to [0, 1] between 0.2 and 100.
        statistics: Per-triangle statistics.
        triangle: int32 index of the nearest triangle, -1 where there is none.
        barycentrics: Perspective-correct weights of its vertices, summing to 1; 0 where there is none.

    Example:
        >>> owl, _ = etsplat.normalize_mesh(etsplat.demo_object())
        >>> camera = etsplat.orbit_cameras(16, 16)[0]
        >>> seen = etsplat.render_opaque(owl.vertices, faces=owl.faces, vertex_colors=0 * owl.vertices, cameras=camera)
        >>> seen.alpha.shape, seen.depth is None
        (torch.Size([1, 16, 16, 1]), True)
    """

    __repr__ = short_repr

    color: Float[Tensor, "B H W C"]
    alpha: Float[Tensor, "B H W 1"]
    depth: Float[Tensor, "B H W 1"] | None = None
    median_depth: Float[Tensor, "B H W 1"] | None = None
    normal: Float[Tensor, "B H W 3"] | None = None
    distortion: Float[Tensor, "B H W 1"] | None = None
    statistics: TriangleStatistics | None = None
    triangle: Int[Tensor, "B H W"] | None = None
    barycentrics: Float[Tensor, "B H W 3"] | None = None

    @property
    def rgba(self) -> Float[Tensor, "B H W C+1"]:
        """Colour, then alpha, as one tensor."""
        return torch.cat([self.color, self.alpha], dim=-1)


def names_of(outputs: Sequence[str]) -> frozenset[str]:
    """Outputs that are asked for, of which one may be a word. Raises ValueError where they are no names."""
    try:
        return frozenset([outputs] if isinstance(outputs, str) else outputs)
    except TypeError:
        raise ValueError(f"outputs must be names, such as ('depth',), got {shown(outputs)}") from None


def joined(renderings: Sequence[Rasterization]) -> Rasterization:
    """Renderings of single views, one or more, as one of them all."""

    def join(parts: Sequence[Any]) -> Any:
        if isinstance(parts[0], Tensor):
            return torch.cat(list(parts))
        if parts[0] is None:
            return None
        names = [entry.name for entry in fields(parts[0])]
        return type(parts[0])(**{name: join([getattr(part, name) for part in parts]) for name in names})

    return join(renderings)
