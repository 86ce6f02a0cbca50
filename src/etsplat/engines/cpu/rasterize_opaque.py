"""The CPU engine's side of `rasterize_opaque` and `render_opaque`: csrc/cpu/bind_rasterize_hard.cpp."""

from torch import Tensor

from etsplat import _native
from etsplat.core.rasterization import OpaqueView


def rasterize_opaque(
    points: Tensor, triangles: Tensor, view: OpaqueView, triangle: Tensor, barycentrics: Tensor, depth: Tensor
) -> None:
    """See `Engine.rasterize_opaque`."""
    _native.rasterize_hard(
        *_addresses(points, triangles, view), triangle.data_ptr(), barycentrics.data_ptr(), depth.data_ptr()
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
        *_addresses(points, triangles, view),
        colors.data_ptr() if per_face else 0,
        0 if per_face else colors.data_ptr(),
        colors.shape[1],
        supersampling,
        cull_backfaces,
        image.data_ptr(),
    )


def _addresses(points: Tensor, triangles: Tensor, view: OpaqueView) -> tuple[int | float, ...]:
    return (
        points.data_ptr(),
        triangles.data_ptr(),
        len(points),
        len(triangles),
        view.viewmat.data_ptr(),
        view.K.data_ptr(),
        view.near_plane,
        view.width,
        view.height,
    )
