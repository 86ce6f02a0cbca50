"""Differentiable z-buffer rasterization of a mesh with antialiased silhouettes (Laine et al. 2020).

A pixel shows the nearest triangle at its centre, in the colour of the face or interpolated between its vertices with
perspective-correct barycentrics. That image is a step function of the vertices, so silhouettes are blended: where two
neighbouring pixels see different triangles, and a silhouette edge of the nearer one crosses the segment between their
centres at the fraction d, seen from its own pixel, then

    d < 1/2:  the own pixel gets (1/2 - d) (other colour - own colour)
    d > 1/2:  the other pixel gets (d - 1/2) (own colour - other colour)

An edge is a silhouette if no face across it lies on its other side of the screen (or none at all), and it counts for
a horizontal pair if it is at least as steep as the diagonal, for a vertical pair if at most. d moves with the two ends
of the edge: that is where vertices get gradients from; vertex colours give them more through the barycentrics. Edges
within the surface give none, so the mesh must be welded. A triangle too small to own a pixel has no silhouette.
"""

from jaxtyping import Float
from torch import Tensor

from etsplat.core.connectivity import MeshConnectivity
from etsplat.core.validation import check_device, check_intrinsics, check_like, check_shape
from etsplat.engines.choice import engine_for
from etsplat.ops.rasterize_hard import rasterize_hard


def rasterize_antialiased(
    vertices: Float[Tensor, "V 3"],
    connectivity: MeshConnectivity,
    viewmats: Float[Tensor, "B 4 4"],
    Ks: Float[Tensor, "B 3 3"],
    width: int,
    height: int,
    *,
    face_colors: Float[Tensor, "F C"] | None = None,
    vertex_colors: Float[Tensor, "V C"] | None = None,
    backgrounds: Float[Tensor, "B C"] | None = None,
    near_plane: float = 0.01,
) -> Float[Tensor, "B H W C"]:
    """Picture of an opaque mesh, differentiable by vertices, colours and backgrounds.

    Args:
        vertices: (V, 3) of a welded mesh, world space.
        connectivity: its faces and which of them share edges; ``MeshTopology.connectivity``.
        viewmats: (B, 4, 4) world to camera, OpenCV axes.
        Ks: (B, 3, 3) intrinsics [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels.
        width: Image width in pixels.
        height: Image height in pixels.
        face_colors: (F, C), one colour per face. Exactly one of the two colours is given.
        vertex_colors: (V, C), interpolated perspective-correctly.
        backgrounds: (B, C); None is black.
        near_plane: Triangles with a vertex at this depth or nearer are dropped; > 0.

    Returns:
        (B, H, W, C). The native engines' images and gradients are the same bits in every run.

    Raises:
        ValueError: Wrong shape, dtype or device; the message names the argument.
    """
    colors = _check(vertices, connectivity, viewmats, Ks, face_colors, vertex_colors)
    if backgrounds is None:
        backgrounds = vertices.new_zeros(len(viewmats), colors.shape[1])
    check_shape("backgrounds", backgrounds, (len(viewmats), colors.shape[1]))
    check_like("backgrounds", backgrounds, "vertices", vertices)
    seen = rasterize_hard(vertices, viewmats, Ks, width, height, faces=connectivity.faces, near_plane=near_plane)
    found = seen.triangle, seen.barycentrics, seen.depth
    per_face = face_colors is not None
    return engine_for(vertices).antialias(
        vertices, colors, backgrounds, viewmats, Ks, *found, near_plane, per_face, connectivity
    )


def _check(
    vertices: Tensor,
    connectivity: MeshConnectivity,
    viewmats: Tensor,
    Ks: Tensor,
    face_colors: Tensor | None,
    vertex_colors: Tensor | None,
) -> Tensor:
    """Checks what ``rasterize_hard`` does not; returns the colours."""
    check_shape("vertices", vertices, (connectivity.num_vertices, 3))
    check_device("connectivity", connectivity.faces, "vertices", vertices)
    check_shape("viewmats", viewmats, ("B", 4, 4))
    check_shape("Ks", Ks, (len(viewmats), 3, 3))
    if Ks.is_cpu:  # reading them would wait for a GPU
        check_intrinsics("Ks", Ks)
    if (face_colors is None) == (vertex_colors is None):
        raise ValueError("exactly one of face_colors and vertex_colors must be given")
    for name, colors, count in (
        ("face_colors", face_colors, len(connectivity.faces)),
        ("vertex_colors", vertex_colors, len(vertices)),
    ):
        if colors is not None:
            check_shape(name, colors, (count, "C"))
            check_like(name, colors, "vertices", vertices)
            return colors
    raise AssertionError
