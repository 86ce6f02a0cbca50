"""Z-buffer rasterization of opaque triangles, without gradients.

It draws the ground truth of a mesh, opaque previews and the sharp rendering of a finished soup. A sample belongs to a
triangle by the top-left rule: inside, or on a left or top edge; adjacent triangles neither overlap nor leave a crack.
The nearest triangle wins, of equally near ones the smaller index. A triangle with a vertex at or behind the near plane,
with non-finite data or without area on the screen is dropped whole; small and thin ones are kept.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from etsplat.core.rasterization import HardRasterization, OpaqueView
from etsplat.core.validation import check_device, check_indices, check_intrinsics, check_like, check_shape, dense
from etsplat.engines.choice import engine_for

MAX_SUPERSAMPLING = 16


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

    Raises:
        ValueError: Wrong shape, dtype, device or index; the message names the argument.
    """
    points, triangles = _check_mesh(vertices, faces)
    viewmats, Ks = _check_views(vertices, viewmats, Ks, width, height, near_plane)
    views = len(viewmats)
    triangle = torch.empty((views, height, width), dtype=torch.int32, device=vertices.device)
    barycentrics = vertices.new_empty((views, height, width, 3))
    depth = vertices.new_empty((views, height, width))
    engine = engine_for(vertices)
    for b in range(views):
        view = OpaqueView(viewmats[b], Ks[b], width, height, near_plane)
        engine.rasterize_opaque(points, triangles, view, triangle[b], barycentrics[b], depth[b])
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
    engine = engine_for(vertices)
    for b in range(len(viewmats)):
        view = OpaqueView(viewmats[b], Ks[b], width, height, near_plane)
        engine.render_opaque(
            points, triangles, view, colors, face_colors is not None, supersampling, cull_backfaces, image[b]
        )
    return image


def _check_mesh(vertices: Tensor, faces: Tensor | None) -> tuple[Tensor, Tensor]:
    """Contiguous (V, 3) points and (F, 3) int32 faces."""
    if faces is None:
        check_shape("vertices", vertices, ("N", 3, 3))
        points = dense(vertices, "vertices").view(-1, 3)
        return points, torch.arange(len(points), dtype=torch.int32, device=points.device).view(-1, 3)
    check_shape("vertices", vertices, ("V", 3))
    check_shape("faces", faces, ("F", 3))
    if faces.is_cpu:  # reading them would wait for a GPU, which leaves out what is out of range
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
    if Ks.is_cpu:  # reading them would wait for a GPU
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
