"""Z-buffer rasterization of opaque triangles, without gradients.

It draws the ground truth of a mesh, opaque previews and the sharp rendering of a finished soup. A sample belongs to a
triangle by the top-left rule: inside, or on a left or top edge; adjacent triangles neither overlap nor leave a crack.
The nearest triangle wins, of equally near ones the smaller index. A triangle with a vertex at or behind the near plane,
with non-finite data or without area on the screen is dropped whole; small and thin ones are kept.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from etsplat.core.cameras import Cameras, check_views, view_arguments
from etsplat.core.rasterization import OpaqueView, Rasterization
from etsplat.core.validation import (
    check_above,
    check_count,
    check_device,
    check_flags,
    check_indices,
    check_integers,
    check_intrinsics,
    check_last_rows,
    check_like,
    check_shape,
    dense,
)
from etsplat.engines.choice import engine_for
from etsplat.ops.rasterize import one_kind_of_colors

MAX_SUPERSAMPLING = 16


@torch.no_grad()
def rasterize_opaque(
    vertices: Float[Tensor, "V 3"] | Float[Tensor, "N 3 3"],
    *,
    viewmats: Float[Tensor, "B 4 4"] | None = None,
    Ks: Float[Tensor, "B 3 3"] | None = None,
    width: int | None = None,
    height: int | None = None,
    cameras: Cameras | None = None,
    faces: Int[Tensor, "F 3"] | None = None,
    near_plane: float = 0.01,
) -> Rasterization:
    """The nearest triangle at every pixel centre.

    Args:
        vertices: (V, 3) with ``faces``, or (N, 3, 3) without.
        viewmats: (B, 4, 4) world to camera, OpenCV axes.
        Ks: (B, 3, 3) intrinsics [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels.
        width: Image width in pixels.
        height: Image height in pixels.
        cameras: All of the four above in one.
        faces: (F, 3) vertex indices, int32 or int64.
        near_plane: Triangles with a vertex at this depth or nearer are dropped; > 0.

    Returns:
        Triangle, barycentrics and depth; alpha is 1 where there is a triangle, and colour has no channels.

    Raises:
        ValueError: Wrong shape, dtype, device or index; the message names the argument.

    Example:
        >>> vertices, faces = etsplat.icosphere(2)
        >>> cameras = etsplat.orbit_cameras(32, 32, elevations=(0.0,), azimuths=4)
        >>> nearest = etsplat.rasterize_opaque(vertices, faces=faces, cameras=cameras).triangle
        >>> nearest.shape, int(nearest[0, 0, 0])  # the corner of the picture shows none
        (torch.Size([4, 32, 32]), -1)
    """
    points, triangles = _check_mesh(vertices, faces)
    views = _check_views(vertices, *view_arguments(cameras, viewmats, Ks, width, height), near_plane)
    B, H, W = len(views), views.height, views.width
    triangle = torch.empty((B, H, W), dtype=torch.int32, device=vertices.device)
    barycentrics, depth = vertices.new_empty((B, H, W, 3)), vertices.new_empty((B, H, W, 1))
    engine = engine_for(vertices)
    for b in range(B):
        view = OpaqueView(views.viewmats[b], views.Ks[b], W, H, near_plane)
        engine.rasterize_opaque(points, triangles, view, triangle[b], barycentrics[b], depth[b, ..., 0])
    return Rasterization(
        color=vertices.new_empty((B, H, W, 0)),
        alpha=(triangle >= 0).to(vertices.dtype)[..., None],
        depth=depth,
        triangle=triangle,
        barycentrics=barycentrics,
    )


@torch.no_grad()
def render_opaque(
    vertices: Float[Tensor, "V 3"] | Float[Tensor, "N 3 3"],
    *,
    face_colors: Float[Tensor, "F C"] | None = None,
    vertex_colors: Float[Tensor, "V C"] | None = None,
    corner_colors: Float[Tensor, "F 3 C"] | None = None,
    viewmats: Float[Tensor, "B 4 4"] | None = None,
    Ks: Float[Tensor, "B 3 3"] | None = None,
    width: int | None = None,
    height: int | None = None,
    cameras: Cameras | None = None,
    faces: Int[Tensor, "F 3"] | None = None,
    supersampling: int = 4,
    near_plane: float = 0.01,
    cull_backfaces: bool = False,
) -> Rasterization:
    """Antialiased picture of opaque triangles: the mean over a regular grid of samples in every pixel.

    Args:
        vertices: (V, 3) with ``faces``, or (N, 3, 3) without.
        face_colors: (F, C), one colour per triangle. Exactly one of the three colours is given.
        vertex_colors: (V, C), with ``faces``: interpolated perspective-correctly.
        corner_colors: (F, 3, C): the same with a colour of its own for each corner.
        viewmats: (B, 4, 4) world to camera, OpenCV axes.
        Ks: (B, 3, 3) intrinsics [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels.
        width: Image width in pixels.
        height: Image height in pixels.
        cameras: All of the four above in one.
        faces: (F, 3) vertex indices, int32 or int64.
        supersampling: Samples along each axis of a pixel, 1 to 16.
        near_plane: Triangles with a vertex at this depth or nearer are dropped; > 0.
        cull_backfaces: Drop triangles whose vertices run clockwise as seen from the camera.

    Returns:
        Colour (B, H, W, C), premultiplied by the coverage, and the coverage in [0, 1] as alpha.

    Raises:
        ValueError: Wrong shape, dtype, device or index; the message names the argument.

    Example:
        >>> vertices, faces = etsplat.icosphere(2)
        >>> cameras = etsplat.orbit_cameras(32, 32, elevations=(0.0,), azimuths=1)
        >>> red = torch.tensor([[1.0, 0.0, 0.0]]).expand(len(faces), 3)
        >>> picture = etsplat.render_opaque(vertices, faces=faces, face_colors=red, cameras=cameras)
        >>> picture.color[0, 16, 16].tolist(), picture.alpha[0, 0, 0].item()
        ([1.0, 0.0, 0.0], 0.0)
    """
    points, triangles = _check_mesh(vertices, faces)
    views = _check_views(vertices, *view_arguments(cameras, viewmats, Ks, width, height), near_plane)
    count, per_face = len(triangles), face_colors is not None
    name, colors = one_kind_of_colors(face_colors, vertex_colors, corner_colors, faces)
    check_shape(
        name, colors, {"face_colors": (count, "C"), "vertex_colors": (len(points), "C")}.get(name, (count, 3, "C"))
    )
    check_like(name, colors, "vertices", vertices)
    colors = dense(colors, name)
    if colors.ndim == 3:  # every corner a vertex of its own
        points, colors = points[triangles.long()].view(-1, 3), colors.view(3 * count, -1)
        triangles = _separate(points)
    check_flags(cull_backfaces=cull_backfaces)
    supersampling = check_count("supersampling", supersampling, most=MAX_SUPERSAMPLING)
    image = vertices.new_empty((len(views), views.height, views.width, colors.shape[1] + 1))
    engine = engine_for(vertices)
    for b in range(len(views)):
        view = OpaqueView(views.viewmats[b], views.Ks[b], views.width, views.height, near_plane)
        engine.render_opaque(points, triangles, view, colors, per_face, supersampling, cull_backfaces, image[b])
    return Rasterization(color=image[..., :-1], alpha=image[..., -1:])


def _check_mesh(vertices: Tensor, faces: Tensor | None) -> tuple[Tensor, Tensor]:
    """Contiguous (V, 3) points and (F, 3) int32 faces."""
    if faces is None:
        check_shape("vertices", vertices, ("N", 3, 3))
        points = dense(vertices, "vertices").view(-1, 3)
        return points, _separate(points)
    check_shape("vertices", vertices, ("V", 3))
    check_shape("faces", faces, ("F", 3))
    check_integers("faces", faces)
    if faces.is_cpu:  # reading them would wait for a GPU, which leaves out what is out of range
        check_indices("faces", faces, len(vertices))
    check_device("faces", faces, "vertices", vertices)
    return dense(vertices, "vertices"), dense(faces, "faces").to(torch.int32)


def _separate(points: Tensor) -> Tensor:
    """Faces of triangles that share no vertex."""
    return torch.arange(len(points), dtype=torch.int32, device=points.device).view(-1, 3)


def _check_views(vertices: Tensor, viewmats: Tensor, Ks: Tensor, width: int, height: int, near_plane: float) -> Cameras:
    check_views(viewmats, Ks, "vertices", vertices)
    if Ks.is_cpu:  # reading them would wait for a GPU
        check_intrinsics("Ks", Ks)
        check_last_rows("viewmats", viewmats)
    check_above("near_plane", near_plane)
    return Cameras(dense(viewmats, "viewmats"), dense(Ks, "Ks"), width, height)
