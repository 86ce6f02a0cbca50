"""The CPU engine's side of `rasterize_opaque` and `render_opaque`: csrc/cpu/bind_rasterize_opaque.cpp."""

from torch import Tensor

from etsplat import _native
from etsplat.core.rasterization import OpaqueView


def rasterize_opaque(
    points: Tensor, triangles: Tensor, view: OpaqueView, triangle: Tensor, barycentrics: Tensor, depth: Tensor
) -> None:
    """See `Engine.rasterize_opaque`."""
    _native.rasterize_opaque(
        vertices=points,
        faces=triangles,
        viewmat=view.viewmat,
        K=view.K,
        near_plane=view.near_plane,
        triangle=triangle,
        barycentrics=barycentrics,
        depth=depth,
    )


def render_opaque(
    points: Tensor,
    triangles: Tensor,
    view: OpaqueView,
    colors: Tensor,
    per_face: bool,
    supersampling: int,
    cull_backfaces: bool,
    image: Tensor,
) -> None:
    """See `Engine.render_opaque`."""
    _native.render_opaque(
        vertices=points,
        faces=triangles,
        viewmat=view.viewmat,
        K=view.K,
        near_plane=view.near_plane,
        colors=colors,
        per_face=per_face,
        supersampling=supersampling,
        cull_backfaces=cull_backfaces,
        image=image,
    )
