"""Z-buffer rasterization of opaque triangles, without gradients.

It draws the ground truth of a mesh, opaque previews and the sharp rendering of a finished soup. A sample belongs to a
triangle by the top-left rule: inside, or on a left or top edge; adjacent triangles neither overlap nor leave a crack.
The nearest triangle wins, of equally near ones the smaller index. A triangle with a vertex at or behind the near plane,
with non-finite data or without area on the screen is dropped whole; small and thin ones are kept.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from etsplat import _native
from etsplat.core.validation import check_device, check_indices, check_intrinsics, check_like, check_shape, dense
from etsplat.ops._rasterize_hard_cuda import rasterize_hard_cuda, render_opaque_cuda
from etsplat.ops._rasterize_hard_reference import View, rasterize_hard_reference, render_opaque_reference
from etsplat.ops.engines import resolve_engine

MAX_SUPERSAMPLING = 16


@dataclass(frozen=True)
class HardRasterization:
    """What each pixel's centre sees.

    Attributes:
        triangle: Index of the nearest triangle, -1 where there is none.
        barycentrics: Perspective-correct weights of its vertices, summing to 1; 0 where there is none.
        depth: View-space z of the surface point; 0 where there is none.
    """

    triangle: Int[Tensor, "B H W"]
    barycentrics: Float[Tensor, "B H W 3"]
    depth: Float[Tensor, "B H W"]


@torch.no_grad()
def rasterize_hard(
    vertices: Float[Tensor, "V 3"] | Float[Tensor, "N 3 3"],
    viewmats: Float[Tensor, "B 4 4"],
    Ks: Float[Tensor, "B 3 3"],
    width: int,
    height: int,
    *,
    faces: Int[Tensor, "F 3"] | None = None,
    near_plane: float = 0.01,
    engine: str | None = None,
) -> HardRasterization:
    """The nearest triangle at every pixel centre.

    Args:
        vertices: (V, 3) with ``faces``, or (N, 3, 3) without.
        viewmats: (B, 4, 4) world to camera, OpenCV axes.
        Ks: (B, 3, 3) intrinsics [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels.
        width: Image width in pixels.
        height: Image height in pixels.
        faces: (F, 3) vertex indices, int32 or int64.
        near_plane: Triangles with a vertex at this depth or nearer are dropped; > 0.
        engine: "cpu", "cuda", "reference" or None (by dtype and device).

    Raises:
        ValueError: Wrong shape, dtype, device or index; the message names the argument.
    """
    points, triangles = _check_mesh(vertices, faces)
    viewmats, Ks = _check_views(vertices, viewmats, Ks, width, height, near_plane)
    views = len(viewmats)
    triangle = torch.empty((views, height, width), dtype=torch.int32, device=vertices.device)
    barycentrics = vertices.new_empty((views, height, width, 3))
    depth = vertices.new_empty((views, height, width))
    rasterize_view = _RASTERIZE[resolve_engine(engine, vertices)]
    for b in range(views):
        view = View(viewmats[b], Ks[b], width, height, near_plane)
        rasterize_view(points, triangles, view, triangle[b], barycentrics[b], depth[b])
    return HardRasterization(triangle, barycentrics, depth)


@torch.no_grad()
def render_opaque(
    vertices: Float[Tensor, "V 3"] | Float[Tensor, "N 3 3"],
    viewmats: Float[Tensor, "B 4 4"],
    Ks: Float[Tensor, "B 3 3"],
    width: int,
    height: int,
    *,
    faces: Int[Tensor, "F 3"] | None = None,
    face_colors: Float[Tensor, "F C"] | None = None,
    vertex_colors: Float[Tensor, "V C"] | None = None,
    supersampling: int = 4,
    near_plane: float = 0.01,
    cull_backfaces: bool = False,
    engine: str | None = None,
) -> Float[Tensor, "B H W C1"]:
    """Antialiased picture of opaque triangles: the mean over a regular grid of samples in every pixel.

    Args:
        vertices: (V, 3) with ``faces``, or (N, 3, 3) without.
        viewmats: (B, 4, 4) world to camera, OpenCV axes.
        Ks: (B, 3, 3) intrinsics [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels.
        width: Image width in pixels.
        height: Image height in pixels.
        faces: (F, 3) vertex indices, int32 or int64.
        face_colors: (F, C), one colour per triangle. Exactly one of the two colours is given.
        vertex_colors: (V, C), or (3 N, C) without faces, interpolated perspective-correctly.
        supersampling: Samples along each axis of a pixel, 1 to 16.
        near_plane: Triangles with a vertex at this depth or nearer are dropped; > 0.
        cull_backfaces: Drop triangles whose vertices run clockwise as seen from the camera.
        engine: "cpu", "cuda", "reference" or None (by dtype and device).

    Returns:
        (B, H, W, C + 1): colour premultiplied by the coverage, then the coverage in [0, 1].

    Raises:
        ValueError: Wrong shape, dtype, device or index; the message names the argument.
    """
    points, triangles = _check_mesh(vertices, faces)
    viewmats, Ks = _check_views(vertices, viewmats, Ks, width, height, near_plane)
    colors = _check_colors(vertices, points, triangles, face_colors, vertex_colors)
    if not 1 <= supersampling <= MAX_SUPERSAMPLING:
        raise ValueError(f"supersampling must be from 1 to {MAX_SUPERSAMPLING}, got {supersampling}")
    image = vertices.new_empty((len(viewmats), height, width, colors.shape[1] + 1))
    render_view = _RENDER[resolve_engine(engine, vertices)]
    for b in range(len(viewmats)):
        view = View(viewmats[b], Ks[b], width, height, near_plane)
        render_view(points, triangles, view, colors, face_colors is not None, supersampling, cull_backfaces, image[b])
    return image


def _check_mesh(vertices: Tensor, faces: Tensor | None) -> tuple[Tensor, Tensor]:
    """Contiguous (V, 3) points and (F, 3) int32 faces."""
    if faces is None:
        check_shape("vertices", vertices, ("N", 3, 3))
        points = dense(vertices, "vertices").view(-1, 3)
        return points, torch.arange(len(points), dtype=torch.int32, device=points.device).view(-1, 3)
    check_shape("vertices", vertices, ("V", 3))
    check_shape("faces", faces, ("F", 3))
    if faces.device.type == "cpu":  # reading them would wait for a GPU, which leaves out what is out of range
        check_indices("faces", faces, len(vertices))
    check_device("faces", faces, "vertices", vertices)
    return dense(vertices, "vertices"), dense(faces, "faces").to(torch.int32)


def _check_views(
    vertices: Tensor, viewmats: Tensor, Ks: Tensor, width: int, height: int, near_plane: float
) -> tuple[Tensor, Tensor]:
    check_shape("viewmats", viewmats, ("B", 4, 4))
    check_shape("Ks", Ks, (len(viewmats), 3, 3))
    check_like("viewmats", viewmats, "vertices", vertices)
    check_like("Ks", Ks, "vertices", vertices)
    if Ks.device.type == "cpu":  # reading them would wait for a GPU
        check_intrinsics("Ks", Ks)
    if width < 1 or height < 1:
        raise ValueError(f"width and height must be at least 1, got {width} x {height}")
    if not 0.0 < near_plane < float("inf"):
        raise ValueError(f"near_plane must be positive and finite, got {near_plane}")
    return dense(viewmats, "viewmats"), dense(Ks, "Ks")


def _check_colors(
    vertices: Tensor, points: Tensor, triangles: Tensor, face_colors: Tensor | None, vertex_colors: Tensor | None
) -> Tensor:
    if face_colors is not None and vertex_colors is None:
        check_shape("face_colors", face_colors, (len(triangles), "C"))
        check_like("face_colors", face_colors, "vertices", vertices)
        return dense(face_colors, "face_colors")
    if vertex_colors is not None and face_colors is None:
        check_shape("vertex_colors", vertex_colors, (len(points), "C"))
        check_like("vertex_colors", vertex_colors, "vertices", vertices)
        return dense(vertex_colors, "vertex_colors")
    raise ValueError("exactly one of face_colors and vertex_colors must be given")


def _rasterize_cpu(
    points: Tensor, triangles: Tensor, view: View, triangle: Tensor, barycentrics: Tensor, depth: Tensor
) -> None:
    _native.rasterize_hard(
        *_addresses(points, triangles, view), triangle.data_ptr(), barycentrics.data_ptr(), depth.data_ptr()
    )


def _render_cpu(
    points: Tensor,
    triangles: Tensor,
    view: View,
    colors: Tensor,
    per_face: bool,
    supersampling: int,
    cull_backfaces: bool,
    image: Tensor,
) -> None:
    _native.render_opaque(
        *_addresses(points, triangles, view),
        colors.data_ptr() if per_face else 0,
        0 if per_face else colors.data_ptr(),
        colors.shape[1],
        supersampling,
        cull_backfaces,
        image.data_ptr(),
    )


def _addresses(points: Tensor, triangles: Tensor, view: View) -> tuple[int | float, ...]:
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


_RASTERIZE = {"reference": rasterize_hard_reference, "cpu": _rasterize_cpu, "cuda": rasterize_hard_cuda}
_RENDER = {"reference": render_opaque_reference, "cpu": _render_cpu, "cuda": render_opaque_cuda}
